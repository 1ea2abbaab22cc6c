"""Minari: data sets that minari itself wrote, against what minari itself reads."""

from __future__ import annotations

import json

import h5py
import numpy as np
import pytest
import torch

from torchrl_tsallis.data import find_episodes
from torchrl_tsallis.data.readers import describe, read_demonstrations

LENGTHS = [3 + k % 4 for k in range(12)]


@pytest.mark.parametrize("data_format", ["hdf5", "arrow", "parquet"])
def test_vectors_in_the_order_of_the_numbers(write_minari, data_format):
    folder = write_minari("box", data_format)
    data, source = read_demonstrations(folder, next_observation=True)
    expected = [[step, k, 0.5] for k, n in enumerate(LENGTHS) for step in range(n)]
    np.testing.assert_array_equal(data["observation"].numpy(), np.array(expected, np.float32))
    np.testing.assert_array_equal(data["next", "observation"][:, 0].numpy(), np.array(expected)[:, 0] + 1)
    np.testing.assert_array_equal(data["action"].numpy(), np.array(expected, np.float32)[:, :2])
    np.testing.assert_array_equal(data["next", "reward"][:, 0].numpy(), np.array(expected)[:, 0])
    assert find_episodes(data).lengths.tolist() == LENGTHS
    ends = find_episodes(data).ends
    assert data["next", "terminated"][ends, 0].tolist() == [k % 3 == 0 for k in range(12)]
    assert (data["next", "terminated"] | data["next", "truncated"]).sum() == 12  # one that ends by neither is truncated
    assert [name.removeprefix("episode_") for name in source.episodes] == [str(k) for k in range(12)]
    assert source.facts["dataset_id"] == f"toy/box{data_format}-v0"
    assert "observation_space" not in json.dumps(source.to_json())


@pytest.mark.parametrize("data_format", ["hdf5", "arrow"])
@pytest.mark.parametrize("kind", ["dict", "tuple", "discrete"])
def test_nested_observations(write_minari, data_format, kind):
    folder = write_minari(kind, data_format, infos=False)
    data, source = read_demonstrations(folder)
    if kind == "discrete":
        assert data["observation"].shape == (54,) and data["observation"].dtype == torch.int64
        return
    assert data["observation"].shape == (54, 5) and data["observation"].dtype == torch.float32
    parts = {key.rpartition("/")[2]: (a, b) for key, a, b in source.layout}
    first = parts["state" if kind == "dict" else ("_index_0" if data_format == "hdf5" else "0")]
    assert data["observation"][:, first[0] : first[1]][:, 1].unique().tolist() == list(range(12))
    nested, _ = read_demonstrations(folder, concatenate=False, dtype=None)
    assert len(list(nested["observation"].keys())) == 2
    if kind == "dict":
        assert nested["observation", "goal"].dtype == torch.float64


@pytest.mark.parametrize("data_format", ["hdf5", "arrow"])
def test_images_are_decoded_only_where_they_are_asked_for(write_minari, data_format):
    folder = write_minari("dict", data_format)
    summary = describe(folder)
    assert summary.columns["observations/pixels"].image and summary.steps == 54
    data, source = read_demonstrations(folder)
    assert "observations/pixels" in source.left_out
    data, _ = read_demonstrations(folder, observation="*/pixels")
    assert data["observation"].shape == (54, 32, 32, 3)
    assert (data["observation"][data["episode"] == 5].float() - 100).abs().max() < 4  # JPEG


@pytest.mark.parametrize("data_format", ["hdf5", "arrow", "parquet"])
def test_infos_are_entries_too(write_minari, data_format):
    folder = write_minari("box", data_format)
    data, source = read_demonstrations(folder, observation=["observations", "infos/speed"])
    assert data["observation"].shape == (54, 4)
    assert torch.equal(data["observation"][:, 3], data["info", "step"].float())


def test_every_way_of_naming_the_data_set(write_minari):
    folder = write_minari()
    for path in (folder, folder / "data", folder / "data" / "main_data.hdf5"):
        assert describe(path).format == "minari" and describe(path).steps == 54


def test_broken_data_sets(write_minari):
    folder = write_minari()
    file = folder / "data" / "main_data.hdf5"
    whole = file.read_bytes()
    with h5py.File(file, "a") as handle:
        del handle["episode_4"]
    with pytest.raises(ValueError, match="holds 11 episodes, its metadata.json says 12"):
        read_demonstrations(folder)
    file.write_bytes(whole)
    for name, change, error, message in [
        ("observations", np.zeros((9, 3)), ValueError, "'observations' of episode 'episode_4' .* has 9 rows, needed"),
        ("observations", np.zeros((4, 2)), ValueError, r"rows of shape \[2\] in episode 'episode_4' and \[3\]"),
        ("rewards", None, KeyError, "episode 'episode_4' .* has no 'rewards'"),
        ("actions", None, KeyError, "episode 'episode_4' .* has no 'actions'"),
        ("truncations", np.array([1, 0, 0]), ValueError, "episode 'episode_4' .* ends at step 0 by its flags"),
        ("actions", np.zeros((0, 2)), ValueError, "episode 'episode_4' .* is empty"),
        ("actions", np.full((3, 2), np.nan), ValueError, r"'action' is NaN or infinite in 3 of 54 rows, first \[18"),
    ]:
        with h5py.File(file, "a") as handle:
            del handle["episode_4"][name]
            if change is not None:
                handle["episode_4"][name] = change
        with pytest.raises(error, match=message):
            read_demonstrations(folder)
        file.write_bytes(whole)
    file.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"main_data.hdf5' is truncated or broken.*copy it again"):
        read_demonstrations(folder)
    file.write_bytes(whole)
    (folder / "data" / "metadata.json").write_text("{")
    with pytest.raises(ValueError, match=r"metadata.json' is truncated or broken"):
        read_demonstrations(folder)


def test_broken_arrow(write_minari):
    folder = write_minari("box", "arrow")
    file = folder / "data" / "4" / "part-0.arrow"
    whole = file.read_bytes()
    for broken in (whole[: len(whole) // 2], b""):
        file.write_bytes(broken)
        with pytest.raises(ValueError, match=r"4/part-0.arrow' is truncated or broken"):
            read_demonstrations(folder)
    file.unlink()
    with pytest.raises(FileNotFoundError, match="episode '4' of .* has no .arrow or .parquet file"):
        read_demonstrations(folder)
