"""A killed training resumes bit for bit, and a checkpoint that cannot be used says why."""

from __future__ import annotations

import pickle
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from torchrl_tsallis.trainers import resume

HERE = Path(__file__).parent


@pytest.fixture
def make_trainer(monkeypatch):
    monkeypatch.syspath_prepend(str(HERE))
    from train_small import make_trainer

    return make_trainer


def run(*args: str | Path | int) -> int:
    command = [sys.executable, str(HERE / "train_small.py"), *map(str, args)]
    return subprocess.run(command, check=False, capture_output=True).returncode


def test_a_killed_run_resumed_in_a_new_process_equals_an_unbroken_one(tmp_path):
    assert run(tmp_path / "a", tmp_path / "whole.pt") == 0
    assert run(tmp_path / "b", tmp_path / "broken.pt", 20) == -signal.SIGKILL
    assert not (tmp_path / "broken.pt").exists()
    assert any((tmp_path / "b").iterdir())
    assert run(tmp_path / "b", tmp_path / "broken.pt") == 0
    whole, broken = (torch.load(tmp_path / f"{name}.pt", weights_only=True) for name in ("whole", "broken"))
    assert whole.keys() == broken.keys()
    for name in whole:
        assert torch.equal(whole[name], broken[name]), name


def test_resuming_without_a_checkpoint_starts_at_zero(tmp_path, make_trainer):
    trainer, _ = make_trainer(tmp_path)
    assert resume(trainer) == 0
    trainer.train()
    assert resume(make_trainer(tmp_path)[0]) == 40


def test_only_the_newest_checkpoints_are_kept(tmp_path, make_trainer):
    make_trainer(tmp_path, keep_checkpoints=2)[0].train()
    assert len(list(tmp_path.iterdir())) == 2


def test_a_trainer_without_a_folder_cannot_resume(make_trainer):
    with pytest.raises(ValueError, match="checkpoint_dir"):
        resume(make_trainer(None)[0])


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_a_truncated_checkpoint_is_named(tmp_path, make_trainer, share):
    make_trainer(tmp_path)[0].train()
    newest = max(tmp_path.iterdir(), key=lambda path: path.name)
    content = newest.read_bytes()
    newest.write_bytes(content[: int(share * len(content))])
    with pytest.raises(RuntimeError, match=rf"{newest.name}.*(truncated|damaged).*delete"):
        resume(make_trainer(tmp_path)[0])
    newest.unlink()
    assert 0 < resume(make_trainer(tmp_path)[0]) < 40


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ({"hidden": 16}, "(loss_module, The size of tensor a (16)"),
        ({"samples": 48}, "64 samples, the buffer holds 48"),
    ],
)
def test_a_checkpoint_of_another_network_or_data_set_is_refused(tmp_path, make_trainer, other, expected):
    make_trainer(tmp_path)[0].train()
    with pytest.raises(RuntimeError, match="does not fit.*settings") as error:
        resume(make_trainer(tmp_path, **other)[0])
    assert len(str(error.value)) < 600
    assert expected in str(error.value)


def test_loading_never_unpickles(tmp_path, make_trainer, monkeypatch):
    make_trainer(tmp_path)[0].train()
    trainer, _ = make_trainer(tmp_path)
    load = torch.load

    def refuse(*args, **kwargs):
        raise AssertionError("a checkpoint must not be unpickled")

    monkeypatch.setattr(torch, "load", lambda *a, **k: load(*a, **k) if k.get("weights_only") else refuse())
    for name in ("load", "loads", "Unpickler"):
        monkeypatch.setattr(pickle, name, refuse)
    assert resume(trainer) == 40
