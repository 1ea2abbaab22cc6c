"""Copies of TED tensordicts, npz archives and CSV tables, by episode and by sample."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyMemmapStorage, TensorDictReplayBuffer

from torchrl_tsallis.data import find_episodes, save_demonstrations
from torchrl_tsallis.data.curation import curate
from torchrl_tsallis.data.readers import read_demonstrations


def demonstrations() -> TensorDict:
    """Three episodes of 4, 3 and 5 rows that ended by themselves; nested keys, uint8 images."""
    lengths = torch.tensor([4, 3, 5])
    flags = {key: torch.zeros(12, 1, dtype=torch.bool) for key in ("done", "terminated", "truncated")}
    for key in ("done", "terminated"):
        flags[key][lengths.cumsum(0) - 1] = True
    init = torch.zeros(12, 1, dtype=torch.bool)
    init[[0, 4, 7]] = True
    rows = torch.arange(12.0)[:, None]
    state = TensorDict({"pose": rows, "image": torch.zeros(12, 3, 4, 4, dtype=torch.uint8)}, [12])
    number = torch.tensor([5, 6, 8]).repeat_interleave(lengths)
    return TensorDict(
        {"observation": state, "action": rows.clone(), "next": flags, "is_init": init, "episode": number}, [12]
    )


def write_ted(kind: str, folder):
    data, path = demonstrations(), folder / ("ted.safetensors" if kind == "file" else "ted")
    if kind == "file":
        save_demonstrations(path, data, {"std": 0.1})
    elif kind == "memmap":
        data.memmap(path)
    else:
        buffer = TensorDictReplayBuffer(storage=LazyMemmapStorage(50))
        buffer.extend(data)
        buffer.dumps(path)
    return path


@pytest.mark.parametrize("kind", ["file", "memmap", "buffer"])
def test_ted(write_ratings, hashes, tmp_path, kind):
    path = write_ted(kind, tmp_path)
    before = hashes(path)
    out = tmp_path / f"out{path.suffix}"
    folder = write_ratings(path, [0.0, 3.0, 1.0])
    assert curate(folder, out, share=0.34).kept == ("5", "8")
    assert hashes(path) == before
    data, source = read_demonstrations(out)
    assert source.episodes == ("5", "8") and data["observation"][:, 0].tolist() == [0, 1, 2, 3, 7, 8, 9, 10, 11]
    assert data["info", "rating"].tolist() == pytest.approx([1.0] * 4 + [0.5] * 5)
    if kind == "buffer":
        buffer = TensorDictReplayBuffer(storage=LazyMemmapStorage(9))
        buffer.loads(out)
        assert len(buffer) == 9 and buffer[:]["episode"].unique().tolist() == [5, 8]


@pytest.mark.parametrize("kind", ["file", "memmap", "buffer"])
def test_ted_without_steps_still_has_ends(write_ratings, tmp_path, kind):
    path = write_ted(kind, tmp_path)
    folder = write_ratings(path, [0.0, 3.0, 1.0])  # steps 0, .01, .02, .03; 3, 3.01, 3.02; 1, 1.01, ...
    out = tmp_path / f"out{path.suffix}"
    done = curate(folder, out, below=1.02, drop="samples")
    assert done.dropped == {"6": "all its steps", "8": "3 of 5 steps"} and done.kept == ("5", "8")
    data, _ = read_demonstrations(out)
    assert data["observation"][:, 0].tolist() == [0, 1, 2, 3, 7, 8]
    assert data["next", "done"][:, 0].nonzero()[:, 0].tolist() == [3, 5]
    assert data["next", "terminated"][:, 0].tolist() == [False, False, False, True, False, False]
    assert data["next", "truncated"][:, 0].tolist() == [False] * 5 + [True]
    assert find_episodes(data).lengths.tolist() == [4, 2]


def test_npz_without_steps_still_has_ends(write_npz, write_ratings, tmp_path):
    folder = write_ratings(write_npz(), [0.0, 1.0, 2.0, 3.0])
    curate(folder, tmp_path / "out.npz", below=3.02, drop="samples")
    with np.load(tmp_path / "out.npz") as archive:
        assert archive["observations"][:, 0].tolist() == list(range(11))
        assert np.flatnonzero(archive["timeouts"]).tolist() == [6, 10]
        assert np.flatnonzero(archive["terminals"]).tolist() == [2, 8]


def test_npz_of_imitation(tmp_path, write_ratings):
    path = tmp_path / "rollouts.npz"
    acts, obs = np.arange(9.0)[:, None], np.arange(12.0)[:, None]  # episodes of 2, 3 and 4 actions
    np.savez_compressed(path, acts=acts, obs=obs, indices=np.array([2, 5]), terminal=np.array([True, False, True]))
    folder = write_ratings(path, [0.0, 5.0, 1.0])
    curate(folder, tmp_path / "out.npz", below=2.0)
    with np.load(tmp_path / "out.npz") as archive:
        assert archive["acts"][:, 0].tolist() == [0, 1, 5, 6, 7, 8]
        assert archive["obs"][:, 0].tolist() == [0, 1, 2, 7, 8, 9, 10, 11]
        assert archive["indices"].tolist() == [2] and archive["terminal"].tolist() == [True, True]
    assert read_demonstrations(tmp_path / "out.npz")[1].episodes == ("0", "1")
    with pytest.raises(ValueError, match="imitation"):
        curate(folder, tmp_path / "other.npz", below=2.0, drop="samples")


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_csv_keeps_its_cells(tmp_path, write_ratings, delimiter):
    path = tmp_path / ("table.tsv" if delimiter == "\t" else "table.csv")
    rows = [["episode", "obs", "act", "done", "note, free"]]
    rows += [[str(k), f"{t}.50", "1e-3", str(int(t == 2)), "1"] for k in (7, 8, 9) for t in range(3)]
    with path.open("w", newline="", encoding="utf-8-sig") as handle:
        csv.writer(handle, delimiter=delimiter).writerows(rows)
    folder, out = write_ratings(path), tmp_path / f"out{path.suffix}"
    curate(folder, out, below=1.0)
    found = list(csv.reader(out.read_text().splitlines(), delimiter=delimiter))
    assert found[0] == [*rows[0], "rating", "surprise"] and [row[:5] for row in found[1:]] == rows[1:4]
    curate(folder, out, below=1.01, drop="samples", overwrite=True)
    assert [row[0] for row in list(csv.reader(out.read_text().splitlines(), delimiter=delimiter))[1:]] == [
        "7",
        "7",
        "7",
        "8",
    ]
    assert find_episodes(read_demonstrations(out)[0]).lengths.tolist() == [3, 1]


def test_a_copy_can_be_rated_and_curated_again(write_npz, write_ratings, tmp_path):
    curate(write_ratings(write_npz()), tmp_path / "one.npz", share=0.25)
    curate(write_ratings(tmp_path / "one.npz", [3.0, 0.0, 1.0], name="again"), tmp_path / "two.npz", share=0.34)
    with np.load(tmp_path / "two.npz") as archive:
        assert len(archive["actions"]) == 6 and archive["rating"].tolist() == [1.0] * 4 + [0.5] * 2
