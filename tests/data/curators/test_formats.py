"""Copies in each format, read by our readers and by the format's own library where that can be installed."""

from __future__ import annotations

import json
import shutil
import warnings

import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from torchrl_tsallis.data import find_episodes
from torchrl_tsallis.data.curation import curate
from torchrl_tsallis.data.readers import read_demonstrations


def test_robomimic_by_a_filter_key(write_robomimic, write_ratings, hashes, tmp_path):
    path = write_robomimic(tmp_path / "demo.hdf5")  # demo_2, demo_7, demo_10
    before = hashes(path)
    done = curate(write_ratings(path), tmp_path / "out.hdf5", share=0.34)
    assert done.kept == ("demo_2", "demo_7") and hashes(path) == before
    assert any("hdf5_filter_key = 'curated'" in command for command in done.commands)
    _, source = read_demonstrations(tmp_path / "out.hdf5", filter_key="curated")
    assert source.episodes == ("demo_2", "demo_7")
    assert len(read_demonstrations(tmp_path / "out.hdf5")[1].episodes) == 3  # nothing is gone
    with pytest.raises(ValueError, match="'train' already"):
        curate(tmp_path / "ratings", tmp_path / "other.hdf5", share=0.34, name="train")
    with pytest.raises(ValueError, match="window"):
        curate(tmp_path / "ratings", tmp_path / "other.hdf5", share=0.34, drop="samples")
    assert not (tmp_path / "other.hdf5").exists()


def test_robomimic_without_the_episodes(write_robomimic, write_ratings, tmp_path):
    path = write_robomimic(tmp_path / "demo.hdf5")
    done = curate(write_ratings(path, [0.0, 5.0, 0.0]), tmp_path / "out.hdf5", below=1.0, remove=True)  # demo_7
    assert "'better'" in done.notes[0]
    with h5py.File(tmp_path / "out.hdf5") as file:
        assert sorted(file["data"]) == ["demo_10", "demo_2"] and file["data"].attrs["total"] == 7
        assert "env_args" in file["data"].attrs and file["data/demo_2"].attrs["num_samples"] == 3
        assert sorted(file["mask"]) == ["curated", "train"] and sorted(file["mask/train"]) == [b"demo_10", b"demo_2"]


def test_robomimic_of_which_a_subset_was_rated(write_robomimic, write_ratings, tmp_path):
    path = write_robomimic(tmp_path / "demo.hdf5")  # the key train: demo_10 and demo_2
    folder = write_ratings(path, filter_key="train")
    assert curate(folder, tmp_path / "out.hdf5", share=0.5).kept == ("demo_2",)
    curate(folder, tmp_path / "removed.hdf5", share=0.5, remove=True)
    with h5py.File(tmp_path / "removed.hdf5") as file:  # demo_7 was not rated, and stays
        assert sorted(file["data"]) == ["demo_2", "demo_7"] and list(file["mask/curated"]) == [b"demo_2"]


@pytest.mark.parametrize("kind", ["box", "dict"])
@pytest.mark.parametrize("data_format", ["hdf5", "arrow", "parquet"])
def test_minari_loads_the_copy(write_minari, write_ratings, hashes, tmp_path, data_format, kind):
    minari = pytest.importorskip("minari")
    infos = data_format == "hdf5"  # minari cannot read them back from Arrow
    path = write_minari(kind, data_format, infos=infos)
    before = hashes(path)
    done = curate(write_ratings(path), tmp_path / "out", keep_list=[1, 4, 10, 11])
    assert hashes(path) == before and done.steps_kept == sum(3 + k % 4 for k in (1, 4, 10, 11))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        data = minari.MinariDataset(tmp_path / "out" / "data")
        assert data.total_episodes == 4 and data.total_steps == done.steps_kept
        episodes = list(data.iterate_episodes())
    assert [episode.id for episode in episodes] == [0, 1, 2, 3]
    for episode, k in zip(episodes, (1, 4, 10, 11), strict=True):
        assert episode.actions[:, 1].tolist() == [k] * (3 + k % 4)
        if infos:
            np.testing.assert_allclose(episode.infos["rating"], 1 / (1 + k), rtol=1e-6)
            assert "speed" in episode.infos
    rows, source = read_demonstrations(tmp_path / "out")
    assert find_episodes(rows).lengths.tolist() == [4, 3, 5, 6] and len(source.episodes) == 4


def test_minari_by_its_file_alone(write_minari, write_ratings, tmp_path):
    shutil.copy(write_minari() / "data" / "main_data.hdf5", tmp_path / "alone.hdf5")
    curate(write_ratings(tmp_path / "alone.hdf5"), tmp_path / "out.hdf5", below=2.0)
    with h5py.File(tmp_path / "out.hdf5") as file:
        assert sorted(file) == ["episode_0", "episode_1"]
    with pytest.raises(ValueError, match="one observation more"):
        curate(tmp_path / "ratings", tmp_path / "samples.hdf5", below=2.0, drop="samples")


def check_lerobot(out, lengths):
    """What LeRobot relies on: numbers without gaps, pointers to the rows, a table that fits, a declared rating."""
    info = json.loads((out / "meta" / "info.json").read_text())
    assert (info["total_episodes"], info["total_frames"]) == (len(lengths), sum(lengths))
    assert info["features"]["rating"] == {"dtype": "float32", "shape": [1], "names": None}
    tables = [pq.read_table(file) for file in sorted(out.glob("data/*/*.parquet"))]
    index = np.concatenate([table["index"].to_numpy() for table in tables])
    number = np.concatenate([table["episode_index"].to_numpy() for table in tables])
    assert index.tolist() == list(range(sum(lengths))) and np.bincount(number).tolist() == lengths
    for table in tables:
        assert str(table.schema.field("rating").type) == "float"
        if b"huggingface" in (table.schema.metadata or {}):
            declared = json.loads(table.schema.metadata[b"huggingface"])["info"]["features"]
            assert declared["rating"] == {"dtype": "float32", "_type": "Value"}
            assert set(declared) == set(table.column_names)
    return info, number, np.concatenate([table["rating"].to_numpy() for table in tables])


@pytest.mark.parametrize("kind", ["lerobot_v3", "lerobot_v3_chunked", "lerobot_v3_video"])
def test_lerobot_version_3(fixtures, write_ratings, hashes, tmp_path, kind):
    source = fixtures / kind
    before = hashes(source)
    old = [len(rows) for rows in _by_episode(source)]
    done = curate(write_ratings(source, [0.0, 4.0, 1.0, 2.0]), tmp_path / "out", share=0.25)
    assert hashes(source) == before and done.dropped == {"1": "surprise 4"}
    assert '--operation.episode_indices "[1]"' in done.commands[0] and "delete_episodes" in done.commands[0]
    lengths = [old[0], old[2], old[3]]
    info, number, rating = check_lerobot(tmp_path / "out", lengths)
    assert info["splits"] == {"train": "0:3"}
    np.testing.assert_allclose(rating, np.array([1.0, 0.5, 1 / 3])[number], rtol=1e-6)
    table = pq.read_table(tmp_path / "out" / "meta" / "episodes" / "chunk-000" / "file-000.parquet").to_pylist()
    ends = np.cumsum(lengths).tolist()
    assert [row["dataset_to_index"] for row in table] == ends and [row["length"] for row in table] == lengths
    assert [row["episode_index"] for row in table] == [0, 1, 2]
    for row in table:
        file = f"chunk-{row['data/chunk_index']:03d}/file-{row['data/file_index']:03d}.parquet"
        assert row["episode_index"] in pq.read_table(tmp_path / "out" / "data" / file)["episode_index"].to_pylist()
    data, provenance = read_demonstrations(tmp_path / "out", observation="observation.state")
    whole, _ = read_demonstrations(source, observation="observation.state")
    assert torch.equal(data["observation"], whole["observation"][whole["episode"] != 1])
    assert provenance.facts["stale_pointers"] == []
    if kind == "lerobot_v3_video":
        key = "videos/observation.images.top"
        assert [row[f"{key}/from_timestamp"] for row in table] == pytest.approx([0.0, 1.1, 1.8])  # of the same file
        film = f"{key}/chunk-000/file-000.mp4"
        assert (tmp_path / "out" / film).read_bytes() == (source / film).read_bytes()
    with pytest.raises(ValueError, match="video"):
        curate(tmp_path / "ratings", tmp_path / "other", share=0.25, drop="samples")


def _by_episode(source):
    table = [pq.read_table(file, columns=["episode_index"]) for file in sorted(source.glob("data/*/*.parquet"))]
    number = np.concatenate([part["episode_index"].to_numpy() for part in table])
    return [np.flatnonzero(number == k) for k in range(number.max() + 1)]


def test_lerobot_statistics_are_those_of_the_rows_that_stay(fixtures, write_ratings, tmp_path):
    shutil.copytree(fixtures / "lerobot_v3", tmp_path / "source")
    image = {"min": [0.0], "max": [1.0], "mean": [0.5], "std": [0.1], "count": [22]}
    names = dict.fromkeys(("min", "max", "mean", "std", "count", "q50"), [0.0])
    stats = {"action": names, "index": names, "observation.images.top": image}
    (tmp_path / "source" / "meta" / "stats.json").write_text(json.dumps(stats))
    done = curate(write_ratings(tmp_path / "source"), tmp_path / "out", keep_list=["0", "3"])
    found = json.loads((tmp_path / "out" / "meta" / "stats.json").read_text())
    action = read_demonstrations(tmp_path / "out")[0]["action"].double()
    assert found["action"]["mean"] == pytest.approx(action.mean(0).tolist())
    assert found["action"]["std"] == pytest.approx(action.std(0, unbiased=False).tolist())
    assert found["index"]["max"] == [10.0] and found["index"]["count"] == [11] and found["rating"]["max"] == [1.0]
    assert found["observation.images.top"] == image and "observation.images.top" in " ".join(done.notes)


def test_lerobot_version_2_renames_files(write_v21, write_ratings, hashes, tmp_path):
    path = write_v21(tmp_path / "v21")
    info = json.loads((path / "meta" / "info.json").read_text())
    info |= {"chunks_size": 1000, "total_videos": 3, "total_chunks": 1}
    info["data_path"] = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    info["video_path"] = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
    (path / "meta" / "info.json").write_text(json.dumps(info))
    films = path / "videos" / "chunk-000" / "observation.images.cam"
    films.mkdir(parents=True)
    for k in range(3):
        (films / f"episode_{k:06d}.mp4").write_text(f"film {k}")
    lines = [{"episode_index": k, "stats": {"index": {"min": [0], "count": [n]}}} for k, n in enumerate((3, 5, 4))]
    (path / "meta" / "episodes_stats.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    before = hashes(path)
    curate(write_ratings(path, [0.0, 9.0, 0.0]), tmp_path / "out", share=0.34)
    assert hashes(path) == before
    info, _, _ = check_lerobot(tmp_path / "out", [3, 4])
    assert info["total_videos"] == 2 and info["splits"] == {"train": "0:1", "test": "1:2"}
    assert sorted(x.name for x in (tmp_path / "out" / "data" / "chunk-000").iterdir()) == [
        "episode_000000.parquet",
        "episode_000001.parquet",
    ]
    copied = sorted((tmp_path / "out" / "videos").rglob("*.mp4"))
    assert [film.read_text() for film in copied] == ["film 0", "film 2"]
    rows = [json.loads(x) for x in (tmp_path / "out" / "meta" / "episodes_stats.jsonl").read_text().splitlines()]
    assert rows[1]["episode_index"] == 1 and rows[1]["stats"]["index"] == {"min": [3.0], "count": [4]}
    assert read_demonstrations(tmp_path / "out")[1].episodes == ("0", "1")
