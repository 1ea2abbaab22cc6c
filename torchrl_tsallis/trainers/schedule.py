"""A learning-rate schedule as a hook of the trainer."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch.optim.lr_scheduler import LRScheduler, ReduceLROnPlateau
from torchrl.trainers import Trainer, TrainerHookBase

from torchrl_tsallis._checks import check_instance, shown

#: Makes a schedule of an optimizer, as ``partial(CosineAnnealingLR, T_max=23400)``.
MakeSchedule = Callable[[torch.optim.Optimizer], LRScheduler]


class ScheduleHook(TrainerHookBase):
    """Steps a learning-rate schedule after each step of the optimizer, logs ``lr``, and keeps it in checkpoints.

    Args:
        make: makes one of torch's schedules from the optimizer, as ``partial(CosineAnnealingLR, T_max=23400)``.
        optimizer: whose learning rates are scheduled.

    Raises:
        TypeError: if what is made is no ``LRScheduler``, or one whose step needs a metric.

    Examples:
        >>> optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
        >>> hook = ScheduleHook(lambda o: torch.optim.lr_scheduler.ExponentialLR(o, 0.5), optimizer)
        >>> hook.replay(2)
        >>> optimizer.param_groups[0]["lr"]
        0.25
    """

    def __init__(self, make: MakeSchedule, optimizer: torch.optim.Optimizer) -> None:
        if not callable(make):
            raise TypeError(
                f"lr_schedule must be a callable that makes a schedule from the optimizer, got {shown(make)}: pass "
                "partial(CosineAnnealingLR, T_max=...), not the schedule itself"
            )
        check_instance("optimizer", optimizer, torch.optim.Optimizer, "an optimizer such as AdaTerm(loss.parameters())")
        self.make, self.optimizer = make, optimizer
        self.schedule = self._made()

    def _made(self) -> LRScheduler:
        """A schedule that has not begun."""
        schedule = self.make(self.optimizer)
        if not isinstance(schedule, LRScheduler) or isinstance(schedule, ReduceLROnPlateau):
            raise TypeError(
                f"lr_schedule must make an LRScheduler whose step() needs no metric, got {type(schedule).__name__}"
            )
        return schedule

    def __call__(self) -> None:
        """The trainer's hook: one step."""
        self.schedule.step()

    def log(self, _: Any) -> dict[str, float]:
        """The learning rate of the first group."""
        return {"lr": float(self.optimizer.param_groups[0]["lr"])}

    def replay(self, steps: int) -> None:
        """Begins the schedule anew from the groups' initial rates, and takes so many steps of it at once."""
        for group in self.optimizer.param_groups:
            group["lr"] = group.pop("initial_lr", group["lr"])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch expects a step of the optimizer before each of the schedule
            self.schedule = self._made()
            for _ in range(steps):
                self.schedule.step()

    def register(self, trainer: Trainer, name: str = "lr_schedule") -> None:
        """Registers the schedule after each step of the optimizer, its log, and for checkpoints."""
        trainer.register_op("post_optim", self)
        trainer.register_op("post_steps_log", self.log)
        trainer.register_module(name, self)

    def state_dict(self) -> dict[str, Any]:
        """State of the schedule."""
        return self.schedule.state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores the state."""
        self.schedule.load_state_dict(state_dict)
