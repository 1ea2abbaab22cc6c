"""Hooks of the offline trainer: evaluation during training, with early stopping on request."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.trainers import Trainer, TrainerHookBase


class EvaluationHook(TrainerHookBase):
    """Evaluates during training, logs the results under ``eval/``, and stops early on request.

    The evaluation cannot change the training: torch's random numbers are put back after it.

    Args:
        evaluate: returns the results by name, such as ``{"return": 1200.0}``.
        every: steps between two evaluations, a multiple of the trainer's ``log_every``.

    Keyword Args:
        monitor (str): the result that decides about stopping; larger is better. Default: ``"return"``.
        patience (int): stop after so many evaluations in a row without a new best. Default: None, never.

    Raises:
        ValueError: if a number is not positive.
        KeyError: at an evaluation, if its results lack the monitored one.

    Examples:
        >>> hook = EvaluationHook(lambda: {"return": 1.0}, every=100, patience=3)
        >>> hook.best
        -inf
    """

    def __init__(
        self,
        evaluate: Callable[[], Mapping[str, float]],
        every: int,
        *,
        monitor: str = "return",
        patience: int | None = None,
    ) -> None:
        if every < 1 or (patience is not None and patience < 1):
            raise ValueError(f"every and patience must be positive, got {every=} and {patience=}")
        self.evaluate = evaluate
        self.every = every
        self.monitor = monitor
        self.patience = patience
        self.best = -math.inf
        self.without_best = 0
        self._trainer: Trainer | None = None

    def __call__(self, _: TensorDictBase) -> dict[str, Any] | None:
        """Evaluates where it is due; called after each batch of steps."""
        trainer = self._trainer
        if trainer is None:
            raise RuntimeError("register the hook first: hook.register(trainer)")
        if trainer.collected_frames % self.every:
            return None
        with torch.random.fork_rng():
            results = dict(self.evaluate())
        if self.patience is not None:
            if self.monitor not in results:
                raise KeyError(f"the evaluation gives {sorted(results)}, none is the monitored {self.monitor!r}")
            better = results[self.monitor] > self.best
            self.best = max(self.best, results[self.monitor])
            self.without_best = 0 if better else self.without_best + 1
            if self.without_best >= self.patience:
                trainer.request_stop(f"{self.monitor} has not improved for {self.without_best} evaluations")
        return {f"eval/{name}": value for name, value in results.items()} | {"log_pbar": True}

    def register(self, trainer: Trainer, name: str = "evaluation") -> None:
        """Registers the evaluation after each batch of steps, and for checkpoints."""
        self._trainer = trainer
        trainer.register_op("post_steps_log", self)
        trainer.register_module(name, self)

    def state_dict(self) -> dict[str, Any]:
        """The best result, and the evaluations since."""
        return {"best": self.best, "without_best": self.without_best}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores the state."""
        self.best, self.without_best = float(state_dict["best"]), int(state_dict["without_best"])
