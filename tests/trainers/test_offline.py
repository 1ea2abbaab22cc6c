"""The offline trainer: one loop, TorchRL's, with a guard and hooks."""

from __future__ import annotations

import errno
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
from torchrl_tsallis.trainers import GuardedStepper, make_logger, make_offline_trainer, resume
from torchrl_tsallis.trainers.stepper import guard_grads


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
        ({"steps": 0}, "steps must be an integer of at least 1, got 0"),
        ({"log_every": 0}, "log_every must be an integer of at least 1, got 0"),
        ({"steps": -4}, "steps must .* got -4"),
        ({"checkpoint_every": -1}, "checkpoint_every must .* got -1"),
        ({"keep_checkpoints": 0, "checkpoint_dir": "unused"}, "keep_checkpoints must .* got 0"),
        ({"max_skips": -1}, "max_skips must be an integer of at least 0, got -1"),
        ({"clip_norm": -1}, "clip_norm must be a finite number above 0, got -1"),
        ({"clip_norm": 0.0}, "clip_norm must .* got 0.0"),
        ({"clip_norm": math.nan}, "clip_norm must .* got nan"),
        ({"clip_norm": math.inf}, "clip_norm must .* got inf"),
    ],
)
def test_numbers_of_steps_that_do_not_fit(small, settings, message):
    with pytest.raises(ValueError, match=message):
        small.make_trainer(None, **settings)


@pytest.mark.parametrize("name", ["steps", "log_every", "checkpoint_every", "keep_checkpoints", "max_skips"])
@pytest.mark.parametrize("value", [2.5, 4.0, True, "4", None, [4], math.nan])
def test_numbers_of_steps_that_are_no_whole_numbers(small, name, value):
    with pytest.raises(TypeError, match=f"^{name} must be an integer of at least [01], got "):
        small.make_trainer(None, **{name: value})


@pytest.mark.parametrize("value", [True, "1", [1.0], 1j])
def test_a_clip_norm_that_is_no_number(small, value):
    with pytest.raises(TypeError, match="^clip_norm must be a finite number above 0, got "):
        small.make_trainer(None, clip_norm=value)


def test_a_loss_that_is_not_reduced_is_refused():
    loss = TsallisBCLoss(make_policy(3, 2), gamma_mix=0.0, reduction="none")
    data = TensorDict({"observation": torch.zeros(4, 3), "action": torch.zeros(4, 2)}, [4])
    with pytest.raises(ValueError, match="reduction='mean' or 'sum'"):
        make_offline_trainer(loss, make_replay_buffer(data, batch_size=2), AdaTerm(loss.parameters()), steps=100)


def test_a_target_that_nothing_updates_is_refused():
    loss = TsallisBCLoss(make_policy(3, 2))
    data = TensorDict({"observation": torch.zeros(4, 3), "action": torch.zeros(4, 2)}, [4])
    with pytest.raises(ValueError, match="CATSoftUpdate"):
        make_offline_trainer(loss, make_replay_buffer(data, batch_size=2), AdaTerm(loss.parameters()), steps=100)


def trainer_with_bad_batches(small, bad: set[int], **kwargs):
    """A trainer whose batches of the given numbers have infinite observations."""
    trainer, loss = small.make_trainer(None, **kwargs)
    count = iter(range(1000))

    def spoil(batch: TensorDict) -> TensorDict:
        if next(count) in bad:
            batch = batch.clone()
            batch["observation"] = torch.full_like(batch["observation"], math.inf)
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


class TwoLosses(TsallisBCLoss):
    """The loss with a second one, the sum of the weights' squares a member."""

    out_keys = [*TsallisBCLoss.out_keys, "loss_decay"]

    def forward(self, tensordict):
        out = super().forward(tensordict)
        return out.set("loss_decay", sum(p.square().sum() for p in self.parameters()))


@pytest.mark.parametrize("members", [None, 1, 3])
def test_every_loss_is_summed(members):
    torch.manual_seed(0)
    actors = [make_policy(3, 2, hidden=(4,)) for _ in range(members or 1)]
    loss = TwoLosses(actors if members else actors[0], gamma_mix=0.0)
    before = [p.detach().clone() for p in loss.parameters()]
    optimizer = torch.optim.SGD(loss.parameters(), lr=0.5)
    # log-densities whose gradient is 0 leave the second loss alone, by which w - lr * 2 w = 0
    data = TensorDict({"observation": torch.zeros(8, 3), "action": torch.zeros(8, 2)}, [8])
    batch = data.expand(members, 8) if members else data
    grads = torch.autograd.grad(TsallisBCLoss.forward(loss, batch)["loss_tsallis_bc"], list(loss.parameters()))

    class Buffer:
        sampler = make_replay_buffer(data, batch_size=8).sampler
        batch_size = 8

        def sample(self):
            return batch

        def __len__(self):
            return 8

    make_offline_trainer(loss, Buffer(), optimizer, steps=1, log_every=1, progress=False).train()
    for old, new, grad in zip(before, loss.parameters(), grads, strict=True):
        torch.testing.assert_close(new.detach(), -0.5 * grad + 0.0 * old, rtol=1e-5, atol=1e-6)


def test_a_gradient_is_clipped_as_torch_clips_it(small):
    gradient = torch.tensor([3.0, 4.0])
    for members in (False, True):
        weight = torch.nn.Parameter(torch.zeros(2, 2) if members else torch.zeros(2))
        weight.grad = torch.stack([gradient, 0.1 * gradient]) if members else gradient.clone()
        norm, good = guard_grads([weight], torch.zeros(2) if members else torch.zeros(()), clip_norm=1.0)
        expected = torch.nn.Parameter(torch.zeros(2))
        expected.grad = gradient.clone()
        torch.nn.utils.clip_grad_norm_([expected], 1.0)
        torch.testing.assert_close(weight.grad[0] if members else weight.grad, expected.grad)
        if members:
            torch.testing.assert_close(weight.grad[1], 0.1 * gradient)  # shorter than the bound
        torch.testing.assert_close(norm, torch.tensor([5.0, 0.5]) if members else torch.tensor(5.0))
        assert good.all()


def test_an_optimizer_of_other_parameters_is_named(small):
    with pytest.raises(RuntimeError, match=r"no parameter of the optimizer has a gradient.*loss.parameters\(\)"):
        guard_grads([torch.nn.Parameter(torch.zeros(2))], torch.zeros(()))


def test_the_guard_refuses_a_negative_number():
    with pytest.raises(ValueError, match="max_skips"):
        GuardedStepper(-1)


def test_a_folder_that_cannot_be_written_is_named_before_the_training(small, tmp_path):
    (tmp_path / "file").write_text("")
    trainer, loss = small.make_trainer(tmp_path / "file" / "checkpoints")
    before = [p.detach().clone() for p in loss.parameters()]
    with pytest.raises(OSError, match=r"cannot write '.*file/checkpoints'.*choose another output folder"):
        trainer.train()
    assert all(torch.equal(a, b) for a, b in zip(before, loss.parameters(), strict=True))


@pytest.mark.parametrize(
    ("writer", "error"),
    [
        ("tensordict.save", RuntimeError("unable to write to file </x>: No space left on device (28)")),
        ("json.dump", OSError(errno.ENOSPC, "No space left on device")),
        ("os.replace", OSError(errno.EROFS, "Read-only file system")),
    ],
)
def test_a_disk_that_fails_anywhere_in_a_checkpoint_leaves_the_ones_of_before(
    small, tmp_path, monkeypatch, writer, error
):
    small.make_trainer(tmp_path, steps=8)[0].train()
    trainer, _ = small.make_trainer(tmp_path)
    assert resume(trainer) == 8

    def fail(*args, **kwargs):
        raise error

    monkeypatch.setattr(writer, fail)
    with pytest.raises(OSError, match=rf"cannot write '{tmp_path}' .*(No space|Read-only).*free space"):
        trainer.train()
    monkeypatch.undo()
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint-000000000008.torchrl"]
    assert resume(small.make_trainer(tmp_path)[0]) == 8


def test_a_full_disk_stops_the_training_and_keeps_the_checkpoints(small, tmp_path, monkeypatch):
    trainer, _ = small.make_trainer(tmp_path)
    write = zipfile.ZipFile.write

    def full(self, *args, **kwargs):
        if trainer.collected_frames > 20:
            raise OSError(28, "No space left on device")
        return write(self, *args, **kwargs)

    monkeypatch.setattr(zipfile.ZipFile, "write", full)
    with pytest.raises(OSError, match=rf"cannot write '{tmp_path}' .No space left.*choose another output folder"):
        trainer.train()
    monkeypatch.undo()
    assert all(path.suffix == ".torchrl" for path in tmp_path.iterdir())
    assert resume(small.make_trainer(tmp_path)[0]) == 16
