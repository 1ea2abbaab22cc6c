"""Hooks of the offline trainer: evaluation during training, with early stopping on request, and logs of members."""

from __future__ import annotations

import functools
import inspect
import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.checkpoint import GlobalRNGState
from torchrl.trainers import Trainer, TrainerHookBase

from torchrl_tsallis._checks import check_number, check_text, shown

_MANY = 100  # members of a container; one with more is data


def _modules_in(owner: Any, depth: int = 3) -> Iterator[nn.Module]:
    """The modules that an object reaches: in itself, its attributes, arguments, closure and containers."""
    inner: list[Any]
    if isinstance(owner, nn.Module):
        yield from owner.modules()
        inner = [value for value in vars(owner).values() if isinstance(value, nn.Module)] if depth > 0 else []
    elif depth < 0 or isinstance(owner, (str, bytes, int, float, type(None), Tensor, type)):
        return
    elif isinstance(owner, functools.partial):
        inner = [owner.func, *owner.args, *owner.keywords.values()]
    elif isinstance(owner, Mapping) and not isinstance(owner, TensorDictBase):
        inner = list(itertools.islice(owner.values(), _MANY))
    elif isinstance(owner, (list, tuple, set)):
        inner = list(itertools.islice(owner, _MANY))
    elif inspect.isfunction(owner):
        found = inspect.getclosurevars(owner)
        defaults = [*(owner.__defaults__ or ()), *(owner.__kwdefaults__ or {}).values()]
        inner = [*found.nonlocals.values(), *found.globals.values(), *defaults]
    elif inspect.ismethod(owner):
        inner = [owner.__self__, owner.__func__]
    elif not inspect.ismodule(owner) and hasattr(owner, "__dict__"):
        inner = list(vars(owner).values())
    else:
        return
    for value in inner:
        yield from _modules_in(value, depth - 1)


@contextmanager
def undisturbed(*owners: Any) -> Iterator[None]:
    """Puts back, after what is done inside, the mode of every module that is reached, and all random numbers.

    Args:
        *owners: modules, functions that use them, or objects that have them.
    """
    modes = {id(module): (module, module.training) for owner in owners for module in _modules_in(owner)}
    numbers, state = GlobalRNGState(), GlobalRNGState().state_dict()
    try:
        yield
    finally:
        for module, training in modes.values():
            module.training = training
        numbers.load_state_dict(state)


class EvaluationHook(TrainerHookBase):
    """Evaluates during training, logs the results under ``eval/``, and stops early on request.

    The evaluation cannot change the training: the random numbers of torch, NumPy and Python and the mode of the loss's
    and of the evaluation's modules are put back after it. A training that was stopped stays stopped when it is resumed;
    ``trainer.collector.go_on()`` lets it go on.

    Args:
        evaluate: returns the results by name, such as ``{"return": 1200.0}``.
        every: steps between two evaluations, a multiple of the trainer's ``log_every`` and at most its ``steps``.

    Keyword Args:
        monitor (str): the result that decides about stopping; larger is better. Default: ``"return"``.
        patience (int): stop after so many evaluations in a row without a new best. Default: None, never.

    Raises:
        ValueError: if a number is not positive or no integer (``TypeError``); in :meth:`register`, if the trainer
            cannot evaluate every ``every`` steps.
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
        if not callable(evaluate):
            raise TypeError(f"evaluate must be a callable that returns results by name, got {shown(evaluate)}")
        self.evaluate = evaluate
        self.every = int(check_number("every", every, low=1, integer=True))
        self.monitor = check_text("monitor", monitor)
        self.patience = None if patience is None else int(check_number("patience", patience, low=1, integer=True))
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
        with undisturbed(trainer.loss_module, self.evaluate):
            results = self.evaluate()
        if not isinstance(results, Mapping):
            raise TypeError(f"the evaluation must return results by name, as {{'return': 1.0}}, got {results!r}")
        if self.patience is not None:
            if self.monitor not in results:
                raise KeyError(f"the evaluation gives {sorted(results)}, none is the monitored {self.monitor!r}")
            better = results[self.monitor] > self.best
            self.best = max(self.best, float(results[self.monitor])) if better else self.best
            self.without_best = 0 if better else self.without_best + 1
            if self.without_best >= self.patience:
                trainer.request_stop(f"{self.monitor} has not improved for {self.without_best} evaluations")
        return {f"eval/{name}": value for name, value in results.items()} | {"log_pbar": True}

    def register(self, trainer: Trainer, name: str = "evaluation") -> None:
        """Registers the evaluation after each batch of steps, and for checkpoints."""
        grain, steps = trainer.optim_steps_per_batch, trainer.total_frames
        if self.every % grain:
            raise ValueError(
                f"every={self.every} must be a multiple of the trainer's log_every={grain}, after which it evaluates: "
                "change one of the two"
            )
        if self.every > steps:
            raise ValueError(f"every={self.every} never comes in the trainer's steps={steps}: lower it")
        self._trainer = trainer
        trainer.register_op("post_steps_log", self)
        trainer.register_module(name, self)

    def state_dict(self) -> dict[str, Any]:
        """The best result, and the evaluations since."""
        return {"best": self.best, "without_best": self.without_best}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores the state."""
        self.best, self.without_best = float(state_dict["best"]), int(state_dict["without_best"])


class LogMembers(TrainerHookBase):
    """Logs what the loss returns of each member, ``[S]``, as one scalar a member: ``rating_mean/07``."""

    def __call__(self, _: int, averages: TensorDictBase) -> dict[str, Tensor]:
        """The scalars of the members."""
        return {
            f"{name}/{member:02d}": value
            for name, values in averages.items()
            if values.ndim == 1
            for member, value in enumerate(values)
        }

    def register(self, trainer: Trainer, name: str = "log_members") -> None:
        """Registers the hook where the averages are logged."""
        trainer.register_op("post_optim_complete_log", self)
