"""robomimic's HDF5 layout."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import torch

from torchrl_tsallis.data import find_episodes
from torchrl_tsallis.data.readers import describe, read_demonstrations


def test_episodes_are_groups_in_the_order_of_their_numbers(write_robomimic, tmp_path):
    data, source = read_demonstrations(write_robomimic(tmp_path / "low_dim.hdf5"))
    assert source.episodes == ("demo_2", "demo_7", "demo_10")
    assert find_episodes(data).lengths.tolist() == [3, 5, 4]  # although dones are all zero
    assert source.layout == (("obs/eef_pos", 0, 3), ("obs/grip", 3, 4))
    assert data["observation"][:, 3].tolist() == [2.0] * 3 + [7.0] * 5 + [10.0] * 4
    assert {"obs/image", "states", "dones"} <= set(source.left_out)
    assert source.facts["env"] == "Lift" and source.facts["masks"]["better"] == ["demo_7"]
    assert data["next", "reward"].shape == (12, 1) and data["next", "truncated"].sum() == 3
    assert data["action"].dtype == torch.float32


def test_filter_keys(write_robomimic, tmp_path):
    file = write_robomimic(tmp_path / "data.hdf5")
    data, source = read_demonstrations(file, filter_key="train")
    assert source.episodes == ("demo_2", "demo_10") and len(data) == 7
    assert describe(file, filter_key="better").episodes == {"demo_7": 5}
    with pytest.raises(KeyError, match=r"no filter key 'worse', only \['better', 'train'\]"):
        read_demonstrations(file, filter_key="worse")
    with h5py.File(file, "a") as handle:
        handle["mask/old"] = np.array([b"demo_2", b"demo_99"])
    with pytest.raises(ValueError, match=r"'old' .* lists 1 episodes that are not there, first \['demo_99'\]"):
        read_demonstrations(file, filter_key="old")


def test_next_observations_and_images(write_robomimic, tmp_path):
    file = write_robomimic(tmp_path / "data.hdf5")
    data, _ = read_demonstrations(file, next_observation=True)
    assert torch.equal(data["next", "observation"][:, 0], data["observation"][:, 0] + 1)
    data, _ = read_demonstrations(file, images=True)
    assert data["observation", "image"].dtype == torch.uint8 and data["observation", "grip"].shape == (12, 1)
    file = write_robomimic(tmp_path / "other.hdf5", following=False)
    with pytest.raises(KeyError, match="episode 'demo_2' .* has no 'next_obs/eef_pos'"):
        read_demonstrations(file, next_observation=True)


def test_raw_recordings_are_called_that(write_robomimic, tmp_path):
    file = write_robomimic(tmp_path / "demo.hdf5", obs=False)
    with pytest.raises(ValueError, match="raw recording.*dataset_states_to_obs.py"):
        read_demonstrations(file)
    data, _ = read_demonstrations(file, observation="states")
    assert data["observation"].shape == (12, 6)
    assert describe(file).columns["states"].shape == (6,)


@pytest.mark.parametrize(
    ("key", "value", "error", "message"),
    [
        ("obs/grip", None, KeyError, "episode 'demo_7' of .* has no 'obs/grip'"),
        (
            "obs/grip",
            np.zeros((5, 2)),
            ValueError,
            r"'obs/grip' .* shape \[2\] in episode 'demo_7' and \[1\] in 'demo_2'",
        ),
        ("obs/grip", np.zeros((4, 1)), ValueError, "episode 'demo_7' of .* unequal lengths.*'obs/grip': 4"),
        ("actions", None, KeyError, "episode 'demo_7' of .* has no 'actions'"),
        ("actions", np.zeros((0, 2)), ValueError, "episode 'demo_7' of .* unequal lengths.*'actions': 0"),
        (
            "obs/grip",
            np.full((5, 1), np.inf),
            ValueError,
            r"'observation' is NaN or infinite in 5 of 12 rows, first \[3",
        ),
    ],
)
def test_broken_episodes_are_named(write_robomimic, tmp_path, key, value, error, message):
    file = write_robomimic(tmp_path / "data.hdf5")
    with h5py.File(file, "a") as handle:
        del handle["data/demo_7"][key]
        if value is not None:
            handle["data/demo_7"][key] = value
    with pytest.raises(error, match=message):
        read_demonstrations(file)


def test_strange_groups_are_passed_over(write_robomimic, tmp_path):
    file = write_robomimic(tmp_path / "data.hdf5")
    with h5py.File(file, "a") as handle:
        handle["data/notes"] = np.zeros(3)
        handle["mask/nested/deeper"] = np.zeros(3)
        handle["data/demo_2/obs/nowhere"] = h5py.SoftLink("/gone")
        handle["data"].attrs["env_args"] = "free text"
    data, source = read_demonstrations(file)
    assert len(data) == 12 and source.facts["env"] is None and "nested" not in source.facts["masks"]


def test_empty_and_truncated_files(write_robomimic, tmp_path):
    file = write_robomimic(tmp_path / "data.hdf5")
    whole = file.read_bytes()
    for size in (len(whole) // 2, 8, 0):
        file.write_bytes(whole[:size])
        with pytest.raises(ValueError, match=r"data.hdf5' is truncated or broken"):
            read_demonstrations(file)
    with pytest.raises(ValueError, match="empty.hdf5' holds no episode"):
        read_demonstrations(write_robomimic(tmp_path / "empty.hdf5", {}))
    file = write_robomimic(tmp_path / "none.hdf5", {"demo_0": 0})
    with pytest.raises(ValueError, match="episode 'demo_0' of .* is empty"):
        read_demonstrations(file)
