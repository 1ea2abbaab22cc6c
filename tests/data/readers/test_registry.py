"""Formats are found by looking at a path; another is one class."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
import torch

from torchrl_tsallis.data import RobustScaling, make_replay_buffer, split_episodes
from torchrl_tsallis.data.readers import (
    READERS,
    Column,
    RawEpisode,
    Reader,
    concatenate_observations,
    describe,
    read_demonstrations,
    register,
)
from torchrl_tsallis.data.readers import base as module
from torchrl_tsallis.modules import make_policy


def test_every_format_is_found_and_described(write_robomimic, write_minari, write_v21, tmp_path):
    torch_rows = {"observation": torch.zeros(4, 1), "action": torch.zeros(4, 1), "episode": torch.arange(4)}
    from tensordict import TensorDict

    TensorDict(torch_rows, [4]).memmap(tmp_path / "ted")
    np.savez(tmp_path / "a.npz", obs=np.zeros((4, 1)), acts=np.zeros((4, 1)))
    (tmp_path / "a.csv").write_text("obs,act\n1,2\n")
    paths = {
        "robomimic": write_robomimic(tmp_path / "a.hdf5"),
        "minari": write_minari(),
        "lerobot": write_v21(tmp_path / "lerobot"),
        "ted": tmp_path / "ted",
        "npz": tmp_path / "a.npz",
        "csv": tmp_path / "a.csv",
    }
    assert set(paths) == set(READERS)
    for name, path in paths.items():
        assert [key for key, reader in READERS.items() if reader.sniff(path)] == [name]
        summary = describe(path)
        data, source = read_demonstrations(path)
        assert summary.format == source.format == name
        assert summary.steps == len(data) and tuple(summary.episodes) == source.episodes
        json.dumps(summary.to_json()), json.dumps(source.to_json())


def test_another_format_is_one_class(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "READERS", dict(READERS))
    monkeypatch.setattr("torchrl_tsallis.data.readers.READERS", module.READERS)

    @register
    class Steps(Reader):
        name = "steps"

        @classmethod
        def sniff(cls, path):
            return path.suffix == ".steps"

        def columns(self):
            return {"o": Column((2,), "float32", "observation"), "a": Column((), "float32", "action")}

        def lengths(self):
            return {"only": int(self.path.read_text())}

        def episodes(self, keys, reward, following):
            size = self.lengths()["only"]
            yield RawEpisode("only", {"o": np.ones((size, 2)), "a": np.ones(size)})

    (tmp_path / "data.steps").write_text("3")
    data, source = read_demonstrations(tmp_path / "data.steps")
    assert data["action"].shape == (3, 1) and source.format == "steps"


@pytest.mark.parametrize("kind", ["missing", "empty folder", "other folder", "text", "format", "hdf5"])
def test_what_is_nothing_known(tmp_path, kind):
    path, error, message, options = tmp_path / "x", ValueError, "'.*x'.* is none of the formats", {}
    if kind == "missing":
        error, message = FileNotFoundError, "nothing at '.*x'"
    elif kind == "text":
        path.write_text("hello")
    elif kind == "hdf5":
        import h5py

        with h5py.File(path, "w") as file:
            file["observations"] = np.zeros(3)
    else:
        path.mkdir()
        if kind == "other folder":
            (path / "readme.md").write_text("")
            message = r"a folder of \['readme.md'\] is none of the formats"
        if kind == "format":
            options, message = {"format": "hdf"}, "no format 'hdf': choose one of lerobot, minari"
    for call in (read_demonstrations, describe):
        with pytest.raises(error, match=message):
            call(path, **options)


@pytest.mark.parametrize("kind", ["hdf5", "npz", "csv", "parquet"])
def test_files_that_may_not_be_read(write_robomimic, write_v21, tmp_path, kind, monkeypatch):
    if kind == "hdf5":
        path = file = write_robomimic(tmp_path / "a.hdf5")
    elif kind == "parquet":
        path = write_v21(tmp_path / "data")
        file = next(path.glob("data/**/*.parquet"))
    else:
        path = file = tmp_path / f"a.{kind}"
        path.write_bytes(b"x")
    opened = type(path).open

    def refuse(self, *arguments, **options):
        if self == file:
            raise PermissionError(13, "Permission denied", str(self))
        return opened(self, *arguments, **options)

    monkeypatch.setattr(type(path), "open", refuse)
    monkeypatch.setattr("zipfile.ZipFile", refuse)
    with pytest.raises(PermissionError, match="no permission to read"):
        read_demonstrations(path)


BLOCKED = """
from importlib.machinery import PathFinder
find = PathFinder.find_spec
def find_spec(name, path=None, target=None):
    return None if name.split(".")[0] in {"h5py", "pyarrow", "minari"} else find(name, path, target)
PathFinder.find_spec = find_spec
import sys
from torchrl_tsallis.data.readers import read_demonstrations
for path in sys.argv[1:]:
    try:
        read_demonstrations(path)
    except ImportError as error:
        print(error)
"""


def test_without_the_extra_the_message_names_it(write_robomimic, write_v21, tmp_path):
    paths = [str(write_robomimic(tmp_path / "a.hdf5")), str(write_v21(tmp_path / "data"))]
    done = subprocess.run([sys.executable, "-c", BLOCKED, *paths], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 2 and all("torchrl-tsallis[formats]" in line for line in lines)
    assert "h5py" in lines[0] and "pyarrow" in lines[1]


def test_concatenated_observations_have_a_layout():
    from tensordict import TensorDict

    parts = TensorDict({"a": torch.ones(4, 2), "b": torch.arange(4), "image": torch.zeros(4, 2, 2)}, [4])
    data = TensorDict({"observation": parts, "next": {"observation": parts.clone()}}, [4])
    out, layout = concatenate_observations(data, ["b", "a"])
    assert layout == (("b", 0, 1), ("a", 1, 3))
    assert out["observation"].tolist()[3] == [3, 1, 1] and torch.equal(out["next", "observation"], out["observation"])
    assert data["observation"] is not out["observation"]
    with pytest.raises(ValueError, match="'image' is no vector"):
        concatenate_observations(data)
    with pytest.raises(KeyError, match="no 'c'"):
        concatenate_observations(data, ["c"])
    with pytest.raises(ValueError, match="one tensor already"):
        concatenate_observations(out)


def test_from_a_file_to_the_same_densities_in_any_unit(write_robomimic, tmp_path):
    file = write_robomimic(tmp_path / "a.hdf5", {f"demo_{k}": 20 for k in range(6)})
    densities = []
    for unit in (1.0, 1e-3, 1e3):
        data, _ = read_demonstrations(file)
        generator = torch.Generator().manual_seed(0)
        noise = torch.randn(data["action"].shape, generator=generator)
        data["action"] = unit * (data["observation"][:, :2] + noise)
        training, _ = split_episodes(data, 0.2, seed=1)
        batch = make_replay_buffer(RobustScaling.fit(training)(training), batch_size=32).sample()
        torch.manual_seed(0)
        policy = make_policy(4, 2, hidden=(8,))
        densities.append(policy.get_dist(batch).log_prob(batch["action"]))
    torch.testing.assert_close(densities[1], densities[0], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(densities[2], densities[0], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"observation": 3}, TypeError, "observation=3 must be a key"),
        ({"observation": [1, 2]}, TypeError, r"observation=\[1, 2\] must be"),
        ({"action": {"a": 1}}, TypeError, "action="),
        ({"reward": ["r"]}, TypeError, "reward="),
        ({"action": []}, KeyError, r"action=\[\] names no entry"),
        ({"observation": []}, KeyError, "name its keys"),
        ({"observation": "next*"}, KeyError, "no 'next[*]' for the observation"),
        ({"reward": "return"}, KeyError, "no 'return' for the reward"),
        ({"filter_key": "train"}, ValueError, "npz, which has no filter_key"),
        ({"next_observation": True}, KeyError, "no 'next_obs'"),
        ({"format": "csv"}, ValueError, "broken"),
    ],
)
def test_options_that_do_not_fit(tmp_path, options, error, message):
    np.savez(tmp_path / "a.npz", obs=np.zeros((4, 1)), acts=np.zeros((4, 1)))
    with pytest.raises(error, match=message):
        read_demonstrations(tmp_path / "a.npz", **options)
