"""A purely offline trainer, assembled from TorchRL's own ``Trainer``: there is no second training loop.

TorchRL's trainer counts the frames that a collector delivers. Offline, one frame is one gradient step, and the
"collector" is a clock that says how many of them lie between two points of logging, evaluation or saving.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.checkpoint import Checkpoint, CheckpointRotation, GlobalRNGState
from torchrl.data import ReplayBuffer
from torchrl.objectives.common import LossModule
from torchrl.objectives.utils import TargetNetUpdater
from torchrl.record.loggers.common import Logger
from torchrl.trainers import DefaultOptimizationStepper, Trainer, TrainerHookBase

from torchrl_tsallis.data.storage import single_precision
from torchrl_tsallis.ratings.tuner import RatingTuner
from torchrl_tsallis.trainers.stacked import LogMembers, MemberStepper


class OfflineClock:
    """Stands where a trainer expects its collector; delivers ``steps`` empty frames at a time.

    Args:
        steps: gradient steps between two points of logging.

    Examples:
        >>> next(iter(OfflineClock(117))).numel()
        117
    """

    init_random_frames = 0

    def __init__(self, steps: int) -> None:
        self.steps = steps

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Delivers frames without end; the trainer stops by itself."""
        while True:
            yield TensorDict({}, [self.steps])

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Seeds torch, as a collector's environments would be."""
        torch.manual_seed(seed)
        return seed

    def update_policy_weights_(self, *args: Any, **kwargs: Any) -> None:
        """There is no policy to update."""

    def shutdown(self, *args: Any, **kwargs: Any) -> None:
        """There is nothing to shut down."""

    def state_dict(self) -> dict[str, Any]:
        """The clock has no state."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """The clock has no state."""


class SampleHook(TrainerHookBase):
    """Feeds the trainer from a replay buffer, and keeps the sampler and its random numbers in checkpoints.

    Args:
        replay_buffer: the demonstrations.
    """

    def __init__(self, replay_buffer: ReplayBuffer) -> None:
        self.replay_buffer = replay_buffer
        self._single = False

    def __call__(self, _: TensorDictBase) -> TensorDictBase:
        """Samples a batch."""
        return single_precision(self.replay_buffer.sample()) if self._single else self.replay_buffer.sample()

    def register(self, trainer: Trainer, name: str = "sampler") -> None:
        """Registers the sampling before each step, and for checkpoints; a float32 loss gets float32 batches."""
        self._single = {p.dtype for p in trainer.loss_module.parameters()} == {torch.float32}
        trainer.register_op("process_optim_batch", self)
        trainer.register_module(name, self)

    def state_dict(self) -> dict[str, Any]:
        """State of the sampler and of its generator; the data itself is not saved."""
        rng = self.replay_buffer.sampler._rng
        state = {"sampler": dict(self.replay_buffer.sampler.state_dict()), "samples": len(self.replay_buffer)}
        return state if rng is None else {**state, "rng": rng.get_state()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores the state."""
        sampler = self.replay_buffer.sampler
        samples = int(state_dict["samples"])
        if samples != len(self.replay_buffer):
            raise ValueError(
                f"the checkpoint was made with {samples} samples, the buffer holds {len(self.replay_buffer)}: "
                "resume with the same data, or start anew in another output folder"
            )
        sampler.load_state_dict(state_dict["sampler"])
        if "rng" in state_dict:
            rng = sampler._rng or torch.Generator()
            rng.set_state(state_dict["rng"].clone())
            self.replay_buffer.set_rng(rng)


class GuardedStepper(DefaultOptimizationStepper):
    """TorchRL's optimization step that leaves a non-finite step out, and gives up after too many in a row.

    Args:
        max_skips: steps in a row that may be skipped.

    Raises:
        FloatingPointError: in :meth:`step`, after more than ``max_skips`` skipped steps in a row. The policy is as it
            was before them.
    """

    def __init__(self, max_skips: int = 10) -> None:
        super().__init__()
        if max_skips < 0:
            raise ValueError(f"max_skips must not be negative, got {max_skips}")
        self.max_skips = max_skips
        self.skipped = 0
        self.in_a_row = 0

    def step(self, trainer: Trainer, sub_batch: TensorDictBase) -> TensorDictBase:
        """One step of the optimizer; the returned losses are detached, or their graphs would pile up."""
        losses = trainer.compute_loss(sub_batch)
        loss = sum(value for key, value in losses.items() if key.startswith("loss"))
        loss.backward()
        norm = self._compute_and_clip_grad_norm(trainer.optimizer, trainer.clip_grad_norm, trainer.clip_norm)
        if math.isfinite(norm) and math.isfinite(loss.item()):
            trainer.optimizer.step()
            self.in_a_row = 0
        else:
            self.skipped += 1
            self.in_a_row += 1
        trainer.optimizer.zero_grad()
        if self.in_a_row > self.max_skips:
            raise FloatingPointError(
                f"{self.in_a_row} steps in a row up to step {trainer._optim_count} had a loss or gradient that is not "
                f"finite (loss {loss.item()}, gradient norm {norm}): check the data by validate_demonstrations, or "
                "lower the learning rate; the policy is as it was before them"
            )
        out = losses.detach()
        out["grad_norm"] = torch.tensor(norm)
        out["skipped_steps"] = torch.tensor(float(self.skipped))
        return out

    def state_dict(self) -> dict[str, Any]:
        """Counts of skipped steps."""
        return {"skipped": self.skipped, "in_a_row": self.in_a_row}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores the counts."""
        self.skipped, self.in_a_row = int(state_dict["skipped"]), int(state_dict["in_a_row"])


def make_offline_trainer(
    loss: LossModule,
    replay_buffer: ReplayBuffer,
    optimizer: torch.optim.Optimizer,
    *,
    steps: int,
    updater: TargetNetUpdater | None = None,
    tuner: RatingTuner | None = None,
    logger: Logger | None = None,
    log_every: int = 100,
    checkpoint_dir: str | os.PathLike[str] | None = None,
    checkpoint_every: int = 1000,
    keep_checkpoints: int = 2,
    max_skips: int = 10,
    clip_norm: float | None = None,
    progress: bool = True,
) -> Trainer:
    """Assembles TorchRL's trainer for a fixed data set.

    After each optimizer step the target follows, then the rating is tuned.

    Args:
        loss: the loss, as ``TsallisBCLoss``.
        replay_buffer: the demonstrations; ``sample()`` gives a batch.
        optimizer: of the loss's parameters.
        steps: gradient steps in all, a multiple of ``log_every``.
        updater: follows the policy by the target network. Default: None.
        tuner: tunes the rating. Default: None.
        logger: gets the averages of everything the loss returns. Default: None.
        log_every: steps between two logged points (100); also the grain of evaluation, stopping and saving.
        checkpoint_dir: folder of the checkpoints. Default: None, nothing is saved.
        checkpoint_every: steps between two checkpoints (1000), a multiple of ``log_every``.
        keep_checkpoints: how many of the newest ones are kept (2).
        max_skips: non-finite steps in a row that are left out before training stops (10).
        clip_norm: largest norm of the gradient. Default: None.
        progress: whether to show a bar.

    Returns:
        The trainer; call ``train()``. :func:`~torchrl_tsallis.trainers.resume` continues from a checkpoint.

    Raises:
        ValueError: if the numbers of steps do not fit, or the loss has a target network and no updater is given.

    Examples:
        >>> from torchrl_tsallis import AdaTerm, TsallisBCLoss
        >>> from torchrl_tsallis.data import make_replay_buffer
        >>> from torchrl_tsallis.modules import make_policy
        >>> data = TensorDict({"observation": torch.zeros(8, 3), "action": torch.zeros(8, 2)}, [8])
        >>> loss = TsallisBCLoss(make_policy(3, 2), gamma_mix=0.0)
        >>> buffer, optimizer = make_replay_buffer(data, batch_size=4), AdaTerm(loss.parameters())
        >>> trainer = make_offline_trainer(loss, buffer, optimizer, steps=4, log_every=2, progress=False)
        >>> trainer.train()
        >>> trainer.collected_frames
        4
    """
    for name, value, unit in (("steps", steps, log_every), ("checkpoint_every", checkpoint_every, log_every)):
        if value < 1 or unit < 1 or (value % unit and (name == "steps" or checkpoint_dir is not None)):
            raise ValueError(f"{name}={value} must be a positive multiple of {log_every=}: change one of the two")
    if getattr(loss, "needs_target", False) and updater is None:
        raise ValueError("the loss has a target network that nothing updates: pass updater=CATSoftUpdate(loss)")
    members = getattr(loss, "num_members", None)
    rotation = None if checkpoint_dir is None else CheckpointRotation(checkpoint_dir, keep_last=keep_checkpoints)
    trainer = Trainer(
        collector=OfflineClock(log_every),
        total_frames=steps,
        frame_skip=1,
        optim_steps_per_batch=log_every,
        loss_module=loss,
        optimizer=optimizer,
        optimization_stepper=GuardedStepper(max_skips) if members is None else MemberStepper(max_skips),
        target_net_updater=updater,
        logger=logger,
        log_interval=0,
        clip_norm=clip_norm,
        progress_bar=progress,
        checkpoint=Checkpoint(format="archive"),
        checkpoint_rotation=rotation,
        save_trainer_interval=checkpoint_every - 1,  # the trainer saves once more than that has passed
    )
    trainer._last_log = {}  # TorchRL 0.14 shares this dictionary between all trainers alive
    SampleHook(replay_buffer).register(trainer)
    if updater is not None:
        trainer.register_op("post_optim", updater.step)
    if tuner is not None:
        tuner.register(trainer)
    if members is not None:
        LogMembers().register(trainer)
    trainer.register_module("rng", GlobalRNGState())
    trainer.register_op("setup", _show_resumed(trainer))
    return trainer


def _show_resumed(trainer: Trainer) -> Callable[[], None]:
    """A hook that starts the progress bar where the checkpoint was."""

    def hook() -> None:
        if trainer.progress_bar:
            trainer._pbar.update(trainer.collected_frames)

    return hook
