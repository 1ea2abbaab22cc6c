"""Rows on disk: read in pieces, stored once, never written to by a second start."""

from __future__ import annotations

import gc
import os
import socket
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from torchrl_tsallis.data import (
    RobustScaling,
    make_replay_buffer,
    make_sequence_buffer,
    make_stacked_replay_buffer,
    split_episodes,
    validate_demonstrations,
)
from torchrl_tsallis.data import rows as module
from torchrl_tsallis.data.rows import is_memory_mapped


def demonstrations(n: int = 40, seed: int = 0) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)
    t = torch.arange(n)
    rows = {"observation": torch.randn(n, 3, generator=generator), "action": torch.rand(n, 2, generator=generator)}
    return TensorDict({**rows, "is_init": t % 10 == 0, "next": {"done": t % 10 == 9}}, [n])


def on_disk(folder: Path, data: TensorDict) -> TensorDict:
    data.memmap(folder, copy_existing=True)
    return TensorDict.load_memmap(folder)


def batches(buffer, count: int = 6) -> torch.Tensor:
    return torch.cat([buffer.sample()["observation"].flatten(0, -2) for _ in range(count)])


BUFFERS = {
    "pairs": lambda data, **other: make_replay_buffer(data, batch_size=8, **other),
    "stacked": lambda data, **other: make_stacked_replay_buffer(data, seeds=[0, 1], batch_size=8, **other),
    "slices": lambda data, **other: make_sequence_buffer(
        data, slice_len=4, num_slices=2, keys=("observation", "action", "is_init"), **other
    ),
}


@pytest.mark.parametrize("build", BUFFERS.values(), ids=BUFFERS)
def test_memory_mapped_rows_are_read_where_they_are(build, tmp_path):
    data = demonstrations()
    mapped = on_disk(tmp_path / "data", data)
    buffer = build(mapped, scratch_dir=tmp_path / "scratch")
    assert not (tmp_path / "scratch").exists()
    stored = buffer.storage[:]["observation"] if build is not BUFFERS["stacked"] else buffer.storage._storage["action"]
    assert stored.untyped_storage().data_ptr() in {x.untyped_storage().data_ptr() for x in mapped.values(True, True)}
    assert torch.equal(batches(buffer), batches(build(data)))
    with pytest.raises(RuntimeError, match="doesn't allow writing"):
        buffer.extend(data)
    assert torch.equal(TensorDict.load_memmap(tmp_path / "data")["observation"], data["observation"])


@pytest.mark.parametrize("build", BUFFERS.values(), ids=BUFFERS)
def test_a_second_start_uses_what_the_first_stored(build, tmp_path):
    first = build(demonstrations(), scratch_dir=tmp_path)
    stamps = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.memmap")}
    assert len(stamps) >= 2
    second = build(demonstrations(), scratch_dir=tmp_path)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.memmap")} == stamps
    assert torch.equal(batches(first), batches(second))


def test_other_rows_in_the_same_folder_leave_the_first_alone(tmp_path):
    first = make_replay_buffer(demonstrations(), batch_size=8, scratch_dir=tmp_path)
    second = make_replay_buffer(demonstrations(seed=1), batch_size=8, scratch_dir=tmp_path)
    third = make_replay_buffer(demonstrations(n=50), batch_size=8, scratch_dir=tmp_path)
    assert len(list(tmp_path.glob("rows-*"))) == 3
    assert torch.equal(batches(first), batches(make_replay_buffer(demonstrations(), batch_size=8)))
    assert not torch.equal(batches(second), batches(first))
    assert len(third) == 50


def test_half_written_rows_of_a_killed_start_are_removed_and_those_of_a_living_one_kept(tmp_path):
    host = socket.gethostname()
    dead, living, elsewhere = (
        tmp_path / f".writing-{name}-{process}-abc"
        for name, process in ((host, 2**22 + 5), (host, os.getpid()), ("other-host", 1))
    )
    for folder in (dead, living, elsewhere, tmp_path / "rows-strange", tmp_path / "rows-empty"):
        folder.mkdir()
    (tmp_path / "rows-strange" / "meta.json").write_text("{")
    make_replay_buffer(demonstrations(), batch_size=8, scratch_dir=tmp_path)
    assert not dead.exists() and living.exists() and elsewhere.exists()


def test_a_folder_that_cannot_be_used(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="scratch_dir='.*file/rows'.*permissions"):
        make_replay_buffer(demonstrations(), batch_size=8, scratch_dir=tmp_path / "file" / "rows")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module.os, "posix_fallocate", full)
    with pytest.raises(OSError, match="No space left.*MiB are free"):
        make_replay_buffer(demonstrations(), batch_size=8, scratch_dir=tmp_path / "new")
    assert not list((tmp_path / "new").iterdir())


def test_a_full_temporary_folder(tmp_path, monkeypatch):
    mapped = on_disk(tmp_path / "data", demonstrations())
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    monkeypatch.setattr(module, "PIECE", 64)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module.os, "posix_fallocate", full)
    with pytest.raises(OSError, match="No space left.*TMPDIR"):
        split_episodes(mapped, 0.5)
    assert not list((tmp_path / "tmp").iterdir())


def test_pieces_change_nothing(tmp_path, monkeypatch):
    data = demonstrations()
    mapped = on_disk(tmp_path / "data", data)
    whole = RobustScaling.fit(data)(data)
    training, validation = split_episodes(data, 0.5)
    monkeypatch.setattr(module, "PIECE", 64)
    validate_demonstrations(mapped)
    scaled = RobustScaling.fit(mapped)(mapped)
    assert is_memory_mapped(scaled)
    for key, value in whole.items(True, True):
        assert torch.equal(scaled[key], value)
    parts = split_episodes(mapped, 0.5)
    assert all(map(is_memory_mapped, parts))
    for part, expected in zip(parts, (training, validation), strict=True):
        assert all(torch.equal(part[key], value) for key, value in expected.items(True, True))
    assert torch.equal(
        batches(make_replay_buffer(mapped, batch_size=8)), batches(make_replay_buffer(data, batch_size=8))
    )
    bad = mapped["observation"]
    bad[[3, 37], 1] = torch.nan
    with pytest.raises(ValueError, match=r"2 of 40 rows, first \[3, 37\]"):
        validate_demonstrations(mapped)


def test_temporary_rows_go_with_their_data(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    (tmp_path / "tmp").mkdir()
    mapped = on_disk(tmp_path / "data", demonstrations())
    monkeypatch.setattr(module, "PIECE", 64)
    training, validation = split_episodes(mapped, 0.5)
    assert len(list((tmp_path / "tmp").iterdir())) == 2
    action = training["action"]
    del training, validation
    gc.collect()
    assert not list((tmp_path / "tmp").iterdir()) and action.isfinite().all()


def test_members_of_other_layouts_are_refused():
    other = demonstrations().set("action", torch.zeros(40, 3))
    with pytest.raises(ValueError, match=r"'action' is \(\(2,\).*\(\(3,\)"):
        make_stacked_replay_buffer([demonstrations(), other], seeds=[0, 1], batch_size=8)
    with pytest.raises(ValueError, match="5 samples are fewer than a batch of 8"):
        make_stacked_replay_buffer([demonstrations(), demonstrations(5)], seeds=[0, 1], batch_size=8)


def test_memory_mapped_members_stay_off_the_memory(tmp_path):
    a, b = (on_disk(tmp_path / str(k), demonstrations(seed=k)) for k in range(2))
    mapped = make_stacked_replay_buffer([a, b, a], seeds=[0, 1, 2], batch_size=8, scratch_dir=tmp_path / "scratch")
    plain = [demonstrations(seed=k) for k in range(2)]
    plain = make_stacked_replay_buffer([*plain, plain[0]], seeds=[0, 1, 2], batch_size=8)
    assert torch.equal(batches(mapped), batches(plain))
