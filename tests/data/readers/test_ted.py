"""Tensordicts on disk: opened where they are, nothing unpickled."""

from __future__ import annotations

import json
import pickle

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyMemmapStorage, ReplayBuffer

from torchrl_tsallis.data import find_episodes, make_replay_buffer, save_demonstrations
from torchrl_tsallis.data.readers import describe, read_demonstrations
from torchrl_tsallis.data.rows import is_memory_mapped


def rows(n: int = 12) -> TensorDict:
    t = torch.arange(n)
    following = {"done": (t % 4 == 3)[:, None], "reward": t[:, None].float()}
    return TensorDict(
        {"observation": torch.randn(n, 3), "action": torch.rand(n, 2), "episode": 5 + t // 4, "next": following}, [n]
    )


def test_a_memory_map_stays_one(tmp_path):
    data = rows()
    data.memmap(tmp_path / "td")
    found, source = read_demonstrations(tmp_path / "td")
    assert source.format == "ted" and source.episodes == ("5", "6", "7")
    assert torch.equal(found["observation"], data["observation"])
    assert is_memory_mapped(found.select("observation", "action"))
    assert found["info", "step"].tolist() == [0, 1, 2, 3] * 3
    pointer = make_replay_buffer(found, batch_size=4).storage._storage["action"].untyped_storage().data_ptr()
    assert pointer == found["action"].untyped_storage().data_ptr()


def test_a_dumped_buffer_has_the_rows_that_were_written(tmp_path):
    buffer = ReplayBuffer(storage=LazyMemmapStorage(100))
    buffer.extend(rows(8))
    buffer.dumps(tmp_path / "rb")
    found, source = read_demonstrations(tmp_path / "rb")
    assert len(found) == 8 and source.episodes == ("5", "6")
    assert describe(tmp_path / "rb").episodes == {"5": 4, "6": 4}


def test_safetensors(tmp_path):
    save_demonstrations(tmp_path / "data.safetensors", rows(), {})
    found, source = read_demonstrations(tmp_path / "data.safetensors")
    assert find_episodes(found).lengths.tolist() == [4, 4, 4] and source.observation == ("observation",)


def test_nested_observations_are_chosen_and_concatenated(tmp_path):
    nested = {"pose": torch.randn(12, 3), "grip": torch.randn(12, 1)}
    pixels = torch.zeros(12, 4, 4, 3, dtype=torch.uint8)
    data = rows().set("observation", TensorDict({**nested, "pixels": pixels}, [12]))
    data.memmap(tmp_path / "td", copy_existing=True)
    found, source = read_demonstrations(tmp_path / "td")
    assert found["observation"].shape == (12, 4) and source.left_out == ("observation.pixels",)
    found, source = read_demonstrations(tmp_path / "td", images=True)
    assert found["observation", "pixels"].shape == (12, 4, 4, 3)
    found, source = read_demonstrations(tmp_path / "td", observation="observation.pose")
    assert torch.equal(found["observation"], nested["pose"])
    found, source = read_demonstrations(tmp_path / "td", observation=["observation.pose", "*.grip"], concatenate=False)
    assert torch.equal(found["observation", "grip"], nested["grip"])
    with pytest.raises(KeyError, match="no 'observation.force'"):
        read_demonstrations(tmp_path / "td", observation="observation.force")


def test_pairs_without_episodes(tmp_path):
    rows().select("observation", "action").memmap(tmp_path / "td")
    found, source = read_demonstrations(tmp_path / "td")
    assert source.episodes == ("0",) and describe(tmp_path / "td").pairs
    with pytest.raises(ValueError, match="pairs without episodes"):
        find_episodes(found)


class Harmful:
    """Leaves a mark where it is unpickled."""

    def __init__(self, mark) -> None:
        self.mark = str(mark)

    def __reduce__(self):
        return open, (self.mark, "w")


def test_nothing_is_unpickled(tmp_path):
    mark = tmp_path / "mark"
    for name in ("data.pt", "data.pth", "data.pkl"):
        (tmp_path / name).write_bytes(pickle.dumps(Harmful(mark)))
        with pytest.raises(ValueError, match=r"is a pickle.*weights_only=False\).memmap"):
            read_demonstrations(tmp_path / name)
    rows().memmap(tmp_path / "td")
    (tmp_path / "td" / "note").mkdir()
    (tmp_path / "td" / "note" / "other.pickle").write_bytes(pickle.dumps(Harmful(mark)))
    (tmp_path / "td" / "note" / "meta.json").write_text('{"_type": "<class \'tensordict.tensorclass.NonTensorData\'>"}')
    described = json.loads((tmp_path / "td" / "meta.json").read_text())
    described["note"] = {"type": "NonTensorData"}
    (tmp_path / "td" / "meta.json").write_text(json.dumps(described))
    with pytest.raises((ValueError, KeyError), match="td"):
        read_demonstrations(tmp_path / "td")
    assert not mark.exists()


def test_broken_folders(tmp_path):
    rows().memmap(tmp_path / "td")
    file = tmp_path / "td" / "action.memmap"
    whole = file.read_bytes()
    file.write_bytes(whole[:-8])
    with pytest.raises(ValueError, match=r"action.memmap' is truncated: it has 88 of 96 bytes"):
        read_demonstrations(tmp_path / "td")
    file.unlink()
    with pytest.raises((ValueError, FileNotFoundError), match="td"):
        read_demonstrations(tmp_path / "td")
    file.write_bytes(whole)
    (tmp_path / "td" / "meta.json").write_text("{")
    with pytest.raises(ValueError, match=r"meta.json' is truncated or broken"):
        read_demonstrations(tmp_path / "td")


def test_contradicting_ends_name_the_file(tmp_path):
    data = rows().set("episode", torch.zeros(12, dtype=torch.int64))
    data.memmap(tmp_path / "td")
    with pytest.raises(ValueError, match=r"td': the ends of episodes contradict.*first \[3, 7\]"):
        read_demonstrations(tmp_path / "td")
