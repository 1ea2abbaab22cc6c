"""LeRobot: files that it wrote itself (v3.0), its layout (v2.1), and what published data gets wrong."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from torchrl_tsallis.data import find_episodes, make_sequence_buffer, validate_demonstrations
from torchrl_tsallis.data.readers import describe, read_demonstrations


def change(file, **columns):
    """Writes a Parquet file again with other columns."""
    table = pq.read_table(file)
    for name, values in columns.items():
        at = table.column_names.index(name)
        table = table.set_column(at, name, values if isinstance(values, pa.Array) else pa.array(values))
    pq.write_table(table, file)


@pytest.fixture
def v3(fixtures, tmp_path):
    shutil.copytree(fixtures / "lerobot_v3", tmp_path / "v3")
    return tmp_path / "v3"


@pytest.fixture
def chunked(fixtures, tmp_path):
    shutil.copytree(fixtures / "lerobot_v3_chunked", tmp_path / "chunked")
    return tmp_path / "chunked"


def test_version_3_with_scalars_and_without_images(v3):
    data, source = read_demonstrations(v3)
    table = pq.read_table(v3 / "data" / "chunk-000" / "file-000.parquet")
    state, gripper = (np.array(table[key].to_pylist()) for key in ("observation.state", "observation.gripper"))
    np.testing.assert_array_equal(data["observation"].numpy(), np.column_stack([state, gripper]).astype(np.float32))
    assert source.layout == (("observation.state", 0, 3), ("observation.gripper", 3, 4))
    assert data["action"].shape == (22, 2) and data["next", "reward"].shape == (22, 1)
    assert torch.equal(data["episode"], torch.tensor(table["episode_index"].to_pylist()))
    assert torch.equal(data["info", "step"], torch.tensor(table["frame_index"].to_pylist()))
    assert "observation.images.top" in source.left_out and source.episodes == ("0", "1", "2", "3")
    assert source.facts["fps"] == 10 and source.facts["stale_pointers"] == []
    assert source.facts["names"]["observation.state"] == ["x", "y", "z"]
    assert not data["next", "terminated"].any()
    assert torch.equal(data["next", "truncated"], data["next", "done"])
    json.dumps(source.to_json())
    validate_demonstrations(data)
    assert len(find_episodes(data).starts) == 4


def test_images_are_read_only_by_name(v3):
    pytest.importorskip("PIL")
    data, _ = read_demonstrations(v3, images=True)
    assert data["observation", "images_top"].shape == (22, 16, 16, 3)
    data, _ = read_demonstrations(v3, observation="observation.images.*")
    assert data["observation"].dtype == torch.uint8 and len(data["observation"].unique()) > 9


def test_several_chunks_and_files(chunked):
    data, source = read_demonstrations(chunked)
    assert source.episodes == ("0", "1", "2", "3") and data.shape == (24,)
    assert describe(chunked).episodes == {"0": 6, "1": 6, "2": 6, "3": 6}
    seen = make_sequence_buffer(data, slice_len=6, num_slices=4, keys=("observation", "action", "is_init")).sample()
    assert seen["is_init"][:, 0].all()


def test_videos_are_named_and_left_alone(fixtures):
    data, source = read_demonstrations(fixtures / "lerobot_v3_video")
    assert data.shape == (26,) and "observation.images.top" in source.left_out
    with pytest.raises(TypeError, match=r"'observation.images.top' of .* is video"):
        read_demonstrations(fixtures / "lerobot_v3_video", observation="observation.images.top")


@pytest.mark.parametrize("lists", ["fixed", "variable"])
def test_version_2_1(write_v21, tmp_path, lists):
    data, source = read_demonstrations(write_v21(tmp_path / "data", lists=lists))
    assert data["observation"].tolist() == [[step, k] for k, n in enumerate((3, 5, 4)) for step in map(float, range(n))]
    assert find_episodes(data).lengths.tolist() == [3, 5, 4]
    assert "observation.images.cam" in source.left_out
    train, source = read_demonstrations(tmp_path / "data", filter_key="train")
    assert source.episodes == ("0", "1") and len(train) == 8
    test, source = read_demonstrations(tmp_path / "data", filter_key="test")
    assert source.episodes == ("2",) and test["observation"][:, 1].unique().tolist() == [2.0]
    with pytest.raises(KeyError, match=r"no split 'validation', only \['test', 'train'\]"):
        read_demonstrations(tmp_path / "data", filter_key="validation")


def test_rows_out_of_order_are_sorted(chunked):
    whole, _ = read_demonstrations(chunked)
    file = chunked / "data" / "chunk-001" / "file-000.parquet"
    table = pq.read_table(file)
    pq.write_table(table.take([3, 0, 5, 1, 4, 2]), file)
    file.rename(chunked / "data" / "chunk-000" / "file-000b.parquet")  # and the file is not where its rows belong
    again, _ = read_demonstrations(chunked)
    assert all(torch.equal(again[key], value) for key, value in whole.items(True, True))


def test_stale_pointers_are_said_and_do_no_harm(chunked, caplog):
    whole, _ = read_demonstrations(chunked)
    table = chunked / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    change(table, dataset_from_index=[0, 6, 13, 19], dataset_to_index=[6, 13, 19, 25])
    again, source = read_demonstrations(chunked)
    assert source.facts["stale_pointers"] == [1, 2, 3]
    assert "points to other rows for 3 episodes" in caplog.text
    assert torch.equal(again["observation"], whole["observation"])


@pytest.mark.parametrize(
    ("version", "message"),
    [
        ("v2.0", "convert_dataset_v20_to_v21"),
        ("v1.6", "convert_dataset_v1_to_v2"),
        ("v4.0", "update torchrl-tsallis"),
        (None, "LeRobot None"),
    ],
)
def test_other_versions_are_refused_with_the_converter(write_v21, tmp_path, version, message):
    with pytest.raises(ValueError, match=message):
        read_demonstrations(write_v21(tmp_path / "data", version=version))


def test_missing_and_repeated_rows(chunked):
    extra = chunked / "data" / "chunk-001" / "file-002.parquet"
    shutil.copy(chunked / "data" / "chunk-000" / "file-000.parquet", extra)
    with pytest.raises(ValueError, match="episode 0 of .* holds frame 0 twice"):
        read_demonstrations(chunked)
    extra.unlink()
    (chunked / "data" / "chunk-000" / "file-001.parquet").unlink()
    with pytest.raises(ValueError, match="episode 1 of .* has no rows, its table under meta says 6.*download"):
        read_demonstrations(chunked)
    shutil.rmtree(chunked / "data")
    with pytest.raises(FileNotFoundError, match=r"no data/\*\*/\*.parquet: download"):
        read_demonstrations(chunked)


def test_broken_parquet(chunked):
    file = chunked / "data" / "chunk-000" / "file-001.parquet"
    whole = file.read_bytes()
    file.write_bytes(whole[:-100])
    with pytest.raises(ValueError, match=r"file-001.parquet' has no Parquet footer.*not finalised"):
        read_demonstrations(chunked)
    file.write_bytes(b"")
    with pytest.raises(ValueError, match=r"file-001.parquet' has no Parquet footer"):
        read_demonstrations(chunked)
    file.write_bytes(whole[:4] + bytes(len(whole) - 12) + whole[-8:])
    with pytest.raises(ValueError, match=r"file-001.parquet' is truncated or broken"):
        read_demonstrations(chunked)
    file.write_bytes(whole)
    (chunked / "meta" / "info.json").write_text("{")
    with pytest.raises(ValueError, match=r"info.json' is truncated or broken"):
        read_demonstrations(chunked)


def test_broken_rows_name_file_key_and_row(write_v21, tmp_path):
    folder = write_v21(tmp_path / "data", lists="variable")
    file = folder / "data" / "chunk-000" / "episode_000001.parquet"
    kind = pa.list_(pa.float32())
    change(file, action=pa.array([[0.0, 1.0]] * 3 + [[0.0]] + [[0.0, 1.0]], kind))
    with pytest.raises(ValueError, match=r"'action' of .*episode_000001.* has 1 numbers at row 3 and 2 at row 0"):
        read_demonstrations(folder)
    change(file, action=pa.array([[0.0, 1.0]] * 2 + [None] + [[0.0, 1.0]] * 2, kind))
    with pytest.raises(ValueError, match=r"'action' of .*episode_000001.* has no value at row 2"):
        read_demonstrations(folder)
    change(file, action=pa.array([[0.0, 1.0, 2.0]] * 5, kind))
    with pytest.raises(ValueError, match="'action' of .* differs in shape between files"):
        read_demonstrations(folder)
    change(file, action=pa.array([[0.0, np.nan]] * 5, kind))
    with pytest.raises(ValueError, match=r"data'.*'action' is NaN or infinite in 5 of 12 rows, first \[3, 4"):
        read_demonstrations(folder)
    assert len(read_demonstrations(folder, check=False).data) == 12
    table = pq.read_table(file)
    pq.write_table(table.drop_columns(["action"]), file)
    with pytest.raises(KeyError, match=r"episode_000001.* has no column 'action'"):
        read_demonstrations(folder)


def test_metadata_of_the_wrong_kind(write_v21, tmp_path):
    folder = write_v21(tmp_path / "data")
    file = folder / "meta" / "info.json"
    info = json.loads(file.read_text())
    for change, message in [
        ([], "info.json' is truncated or broken .it is list"),
        (info | {"features": ["action"]}, "'features' of .*info.json' must be an object of objects"),
        (info | {"features": {"observation.images.cam": {"dtype": "video", "shape": "wide"}, "action": 3}}, "objects"),
        (info | {"features": {"action": {"dtype": "image", "shape": ["a"]}}}, "info.json' is truncated or broken"),
        (info | {"splits": {"train": "all"}}, r"split 'train' of .*info.json' is 'all', needed is 'from:to'"),
    ]:
        file.write_text(json.dumps(change))
        with pytest.raises(ValueError, match=message):
            read_demonstrations(folder, filter_key="train")
    file.write_text(json.dumps(info))
    lines = folder / "meta" / "episodes.jsonl"
    lines.write_text(lines.read_text() + '{"episode_index": 3, "length": 0}\n')
    with pytest.raises(ValueError, match="episode 3 of .* is empty"):
        read_demonstrations(folder)
    lines.write_text("[]\n")
    with pytest.raises(ValueError, match=r"episodes.jsonl' is truncated or broken"):
        read_demonstrations(folder)
    for parquet in folder.glob("data/**/*.parquet"):
        pq.write_table(pq.read_table(parquet).slice(0, 0), parquet)
    with pytest.raises(ValueError, match="holds no row"):
        read_demonstrations(folder)


def test_free_names(write_v21, tmp_path):
    folder = write_v21(tmp_path / "data")
    for file in folder.glob("data/**/*.parquet"):
        table = pq.read_table(file)
        renamed = {"observation.state": "state", "action": "actions"}
        pq.write_table(table.rename_columns([renamed.get(name, name) for name in table.column_names]), file)
    _, source = read_demonstrations(folder)
    assert (source.observation, source.action) == (("state",), ("actions",))
    with pytest.raises(KeyError, match=r"no 'qpos' for the observation, only \['actions'"):
        read_demonstrations(folder, observation=["qpos"])
    with pytest.raises(ValueError, match="no next observations"):
        read_demonstrations(folder, next_observation=True)
    with pytest.raises(ValueError, match="lerobot, which has no episode"):
        read_demonstrations(folder, episode="episode_index")
