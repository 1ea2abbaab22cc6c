"""The offline trainer: one loop, TorchRL's, with a guard and hooks."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.trainers import Trainer

from torchrl_tsallis import AdaTerm, TsallisBCLoss
from torchrl_tsallis.data import make_replay_buffer
from torchrl_tsallis.modules import make_policy
from torchrl_tsallis.trainers import EvaluationHook, GuardedStepper, make_logger, make_offline_trainer, resume


@pytest.fixture
def small(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    import train_small

    return train_small


def scalars(folder: Path, name: str) -> dict[int, float]:
    lines = (folder / "scalars" / f"{name}.csv").read_text().split()
    return {int(step): float(value) for step, value in (line.split(",") for line in lines)}


def test_it_is_torchrls_trainer_and_takes_every_step(small):
    trainer, _ = small.make_trainer(None)
    counted = []
    trainer.register_op("post_optim", lambda: counted.append(1))
    trainer.train()
    assert type(trainer) is Trainer
    assert trainer.collected_frames == len(counted) == 40


def test_it_equals_a_loop_written_by_hand(small):
    trainer, loss = small.make_trainer(None)
    trainer.train()
    from torchrl_tsallis import CATSoftUpdate, QTuner

    torch.manual_seed(1)
    by_hand = TsallisBCLoss(make_policy(3, 2, hidden=(8,)))
    buffer = make_replay_buffer(small.make_data(), batch_size=16, seed=2)
    optimizer, updater, tuner = AdaTerm(by_hand.parameters()), CATSoftUpdate(by_hand), QTuner(by_hand)
    for _ in range(40):
        by_hand(buffer.sample())["loss_tsallis_bc"].backward()
        optimizer.step()
        optimizer.zero_grad()
        updater.step()
        tuner.step()
    for (name, mine), theirs in zip(loss.state_dict().items(), by_hand.state_dict().values(), strict=True):
        assert torch.equal(mine, theirs), name


def test_what_the_loss_returns_is_logged_as_averages(small, tmp_path):
    trainer, _ = small.make_trainer(None, logger=make_logger("csv", tmp_path, "run"))
    trainer.train()
    for name in ("loss_tsallis_bc", "q", "gamma_mix", "rating_mean", "grad_norm", "skipped_steps"):
        values = scalars(tmp_path / "run", name)
        assert list(values) == list(range(4, 41, 4)), name
        assert all(map(math.isfinite, values.values())), name


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"steps": 41}, "steps=41.*log_every=4"),
        ({"checkpoint_every": 6, "checkpoint_dir": "unused"}, "checkpoint_every=6.*log_every=4"),
        ({"steps": 0}, "steps=0"),
    ],
)
def test_numbers_of_steps_that_do_not_fit(small, settings, message):
    with pytest.raises(ValueError, match=message):
        small.make_trainer(None, **settings)


def test_a_target_that_nothing_updates_is_refused():
    loss = TsallisBCLoss(make_policy(3, 2))
    data = TensorDict({"observation": torch.zeros(4, 3), "action": torch.zeros(4, 2)}, [4])
    with pytest.raises(ValueError, match="CATSoftUpdate"):
        make_offline_trainer(loss, make_replay_buffer(data, batch_size=2), AdaTerm(loss.parameters()), steps=100)


def trainer_with_bad_batches(small, bad: set[int], **kwargs):
    """A trainer whose batches of the given numbers have infinite actions."""
    trainer, loss = small.make_trainer(None, **kwargs)
    count = iter(range(1000))

    def spoil(batch: TensorDict) -> TensorDict:
        if next(count) in bad:
            batch = batch.clone()
            batch["action"] = torch.full_like(batch["action"], math.inf)
        return batch

    trainer.register_op("process_optim_batch", spoil)
    return trainer, loss


def test_a_non_finite_step_is_skipped_and_counted(small, tmp_path):
    trainer, loss = trainer_with_bad_batches(small, {3, 7, 8}, logger=make_logger("csv", tmp_path, "run"))
    trainer.train()
    assert trainer.optimization_stepper.skipped == 3
    assert trainer.optimization_stepper.in_a_row == 0
    assert all(value.isfinite().all() for value in loss.state_dict().values())
    assert scalars(tmp_path / "run", "skipped_steps")[40] == 3


def test_too_many_non_finite_steps_in_a_row_stop_the_training(small):
    trainer, loss = trainer_with_bad_batches(small, set(range(5, 40)), max_skips=4)
    with pytest.raises(FloatingPointError, match="5 steps in a row.*validate_demonstrations"):
        trainer.train()
    assert all(value.isfinite().all() for value in loss.state_dict().values())


def test_the_guard_refuses_a_negative_number():
    with pytest.raises(ValueError, match="max_skips"):
        GuardedStepper(-1)


def test_evaluation_is_logged_and_changes_nothing(small, tmp_path):
    finals = []
    for evaluate in (False, True):
        trainer, loss = small.make_trainer(None, logger=make_logger("csv", tmp_path, f"run{evaluate}"))
        if evaluate:
            EvaluationHook(lambda: {"return": float(torch.rand(()))}, every=8).register(trainer)
        trainer.train()
        finals.append(loss.state_dict())
    assert list(scalars(tmp_path / "runTrue", "eval/return")) == [8, 16, 24, 32, 40]
    assert all(torch.equal(a, b) for a, b in zip(*(final.values() for final in finals), strict=True))


def test_early_stop_after_evaluations_without_a_new_best(small):
    trainer, _ = small.make_trainer(None)
    results = iter([1.0, 3.0, 2.0, 3.0, 9.0])
    hook = EvaluationHook(lambda: {"return": next(results)}, every=4, patience=2)
    hook.register(trainer)
    trainer.train()
    assert trainer.collected_frames == 16
    assert hook.state_dict() == {"best": 3.0, "without_best": 2}


def test_an_evaluation_without_the_monitored_result_names_it(small):
    trainer, _ = small.make_trainer(None)
    EvaluationHook(lambda: {"return": 1.0}, every=4, monitor="median", patience=1).register(trainer)
    with pytest.raises(KeyError, match="return.*median"):
        trainer.train()


@pytest.mark.parametrize("settings", [{"every": 0}, {"every": 4, "patience": 0}])
def test_evaluation_hook_refuses_numbers_that_are_not_positive(settings):
    with pytest.raises(ValueError, match="positive"):
        EvaluationHook(dict, **settings)


def test_a_full_disk_stops_the_training_and_keeps_the_checkpoints(small, tmp_path, monkeypatch):
    trainer, _ = small.make_trainer(tmp_path)
    write = zipfile.ZipFile.write

    def full(self, *args, **kwargs):
        if trainer.collected_frames > 20:
            raise OSError(28, "No space left on device")
        return write(self, *args, **kwargs)

    monkeypatch.setattr(zipfile.ZipFile, "write", full)
    with pytest.raises(OSError, match="No space left"):
        trainer.train()
    monkeypatch.undo()
    assert resume(small.make_trainer(tmp_path)[0]) == 16
