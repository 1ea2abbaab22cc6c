"""A purely offline trainer, assembled from TorchRL's own ``Trainer``: there is no second training loop.

TorchRL's trainer counts the frames that a collector delivers. Offline, one frame is one gradient step, and the
"collector" is a clock that says how many of them lie between two points of logging, evaluation or saving.
"""

from __future__ import annotations

import os
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.checkpoint import Checkpoint, GlobalRNGState
from torchrl.data import ReplayBuffer
from torchrl.objectives.common import LossModule
from torchrl.objectives.utils import TargetNetUpdater
from torchrl.record.loggers.common import Logger
from torchrl.trainers import Trainer, TrainerHookBase

from torchrl_tsallis._checks import check_flag, check_instance, check_number, check_path, shown
from torchrl_tsallis._torchrl import own_log_times, sampler_rng
from torchrl_tsallis.data.storage import single_precision
from torchrl_tsallis.ratings.tuner import RatingTuner
from torchrl_tsallis.trainers.checkpoints import SafeRotation
from torchrl_tsallis.trainers.hooks import LogMembers
from torchrl_tsallis.trainers.logging import LoggerGroup
from torchrl_tsallis.trainers.schedule import MakeSchedule, ScheduleHook
from torchrl_tsallis.trainers.start import OfflineClock, RunStart
from torchrl_tsallis.trainers.stepper import GuardedStepper


def _check_buffer(replay_buffer: Any) -> None:
    """Raises TypeError for what gives no samples; a buffer of a user's own class may."""
    if not (callable(getattr(replay_buffer, "sample", None)) and hasattr(replay_buffer, "sampler")):
        raise TypeError(f"replay_buffer must be a buffer such as make_replay_buffer(data), got {shown(replay_buffer)}")


class SampleHook(TrainerHookBase):
    """Feeds the trainer from a replay buffer, and keeps the sampler and its random numbers in checkpoints.

    Args:
        replay_buffer: the demonstrations.
    """

    def __init__(self, replay_buffer: ReplayBuffer) -> None:
        _check_buffer(replay_buffer)
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
        rng = sampler_rng(self.replay_buffer.sampler)
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
            rng = sampler_rng(sampler) or torch.Generator()
            rng.set_state(state_dict["rng"].clone())
            self.replay_buffer.set_rng(rng)


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
    lr_schedule: MakeSchedule | None = None,
    overwrite: bool = False,
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
        clip_norm: largest norm of the gradient, positive. Default: None.
        lr_schedule: makes a learning-rate schedule from the optimizer, as ``partial(CosineAnnealingLR, T_max=23400)``;
            it takes a step with each of the optimizer, is logged as ``lr`` and kept in checkpoints. Default: None.
        overwrite: whether a training that begins anew removes the checkpoints and log rows of an earlier one (False).
        progress: whether to show a bar.

    Returns:
        The trainer; call ``train()``. :func:`~torchrl_tsallis.trainers.resume` continues from a checkpoint.

    Raises:
        ValueError: if a number is outside of its range (of the wrong kind, ``TypeError``), the numbers of steps do not
            fit, the loss is not reduced, or it has a target network and no updater is given.
        FileExistsError: in ``train()``, if folder or logger hold another run that is neither resumed nor overwritten.

    Examples:
        >>> from tensordict import TensorDict
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
    check_instance("loss", loss, torch.nn.Module, "a loss such as TsallisBCLoss(actor)")
    _check_buffer(replay_buffer)
    check_instance("optimizer", optimizer, torch.optim.Optimizer, "an optimizer such as AdaTerm(loss.parameters())")
    for name, part, method in (
        ("updater", updater, "step"),
        ("tuner", tuner, "register"),
        ("logger", logger, "log_scalar"),
    ):
        if part is not None and (isinstance(part, type) or not callable(getattr(part, method, None))):
            raise TypeError(f"{name} must be an object with a method {method}(), or None, got {shown(part)}")
    check_flag("overwrite", overwrite)
    check_flag("progress", progress)
    if checkpoint_dir is not None:
        check_path("checkpoint_dir", checkpoint_dir)
    whole = {"steps": steps, "log_every": log_every, "checkpoint_every": checkpoint_every}
    for name, value in (whole | {"keep_checkpoints": keep_checkpoints}).items():
        check_number(name, value, low=1, integer=True)
    for name, value in whole.items():
        if value % log_every and (name == "steps" or checkpoint_dir is not None):
            raise ValueError(f"{name}={value} must be a positive multiple of {log_every=}: change one of the two")
    if clip_norm is not None:
        clip_norm = check_number("clip_norm", clip_norm, above=0)
    if getattr(loss, "reduction", None) == "none":
        raise ValueError("the loss is not reduced to a number that can be minimised: give it reduction='mean' or 'sum'")
    if getattr(loss, "needs_target", False) and updater is None:
        raise ValueError("the loss has a target network that nothing updates: pass updater=CATSoftUpdate(loss)")
    members = getattr(loss, "num_members", None)
    rotation = None if checkpoint_dir is None else SafeRotation(checkpoint_dir, keep_last=int(keep_checkpoints))
    stepper = GuardedStepper(max_skips)
    clock = OfflineClock(int(log_every))
    if logger is not None and not isinstance(logger, LoggerGroup):
        logger = LoggerGroup([logger])  # which knows how to cut its rows when the training is resumed
    trainer = Trainer(
        collector=clock,
        total_frames=steps,
        frame_skip=1,
        optim_steps_per_batch=log_every,
        loss_module=loss,
        optimizer=optimizer,
        optimization_stepper=stepper,
        target_net_updater=updater,
        logger=logger,
        log_interval=0,
        clip_norm=clip_norm,
        progress_bar=progress,
        checkpoint=Checkpoint(format="archive"),
        checkpoint_rotation=rotation,
        save_trainer_interval=checkpoint_every - 1,  # the trainer saves once more than that has passed
    )
    own_log_times(trainer)
    clock.follow(trainer)
    SampleHook(replay_buffer).register(trainer)
    if updater is not None:
        trainer.register_op("post_optim", updater.step)
    if tuner is not None:
        tuner.register(trainer)
    if members is not None:
        LogMembers().register(trainer)
    if lr_schedule is not None:
        ScheduleHook(lr_schedule, optimizer).register(trainer)
    trainer.register_module("rng", GlobalRNGState())
    start = RunStart(trainer, overwrite)
    trainer.checkpoint_metadata = start.metadata
    trainer.register_op("setup", start)
    return trainer
