"""What tunes a rating, as a hook of TorchRL's trainer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torchrl.trainers import Trainer, TrainerHookBase

from torchrl_tsallis._checks import check_callable, shown
from torchrl_tsallis.ratings.base import Rating
from torchrl_tsallis.ratings.batch import Batch

if TYPE_CHECKING:
    from torchrl_tsallis.objectives.bc import TsallisBCLoss

#: Makes an optimizer from a list of parameters.
MakeOptimizer = Callable[[list[nn.Parameter]], torch.optim.Optimizer]


class RatingTuner(TrainerHookBase):
    """Base class of the tuners: one free parameter phi a policy, one gradient step on it each training step.

    A subclass says which ratings it fits (``rating_class``), what phi minimises (:meth:`slope`), and where the
    setting that phi stands for is written (:meth:`write`).

    Args:
        loss: the loss whose rating is tuned.
        tuned: the stacked members whose rating is tuned; None for all.
        optimizer: makes the optimizer of phi.

    Raises:
        ValueError: if the tuner does not fit the loss's rating; the message says which does.
    """

    #: The ratings that it fits.
    rating_class: type[Rating] = Rating
    #: Name of the setting that it tunes.
    setting: str = ""

    def __init__(self, loss: TsallisBCLoss, *, tuned: Sequence[bool] | None, optimizer: MakeOptimizer) -> None:
        name, rating = type(self).__name__, getattr(loss, "rating_module", None)
        if rating is None:
            raise ValueError(
                f"{name} needs a loss that rates its samples, got {type(loss).__name__}: use TsallisBCLoss"
            )
        if not isinstance(rating, self.rating_class):
            try:
                advice = f"use {rating.tuner().__name__}"
            except NotImplementedError as error:
                advice = str(error)
            raise ValueError(
                f"{name} tunes {self.rating_class.__name__}, the loss has {type(rating).__name__}: {advice}"
            )
        members = loss.num_members
        if tuned is not None:
            flags = tuned.tolist() if isinstance(tuned, Tensor) else tuned
            if not isinstance(flags, Sequence) or not all(isinstance(flag, bool) for flag in flags):
                raise TypeError(f"tuned must be a sequence of True or False, one a stacked member, got {shown(tuned)}")
            if len(flags) != members:
                raise ValueError(f"tuned has {len(flags)} values for {members or 'no'} stacked members")
            tuned = flags
        check_callable("optimizer", optimizer, "makes an optimizer from a list of parameters")
        self.loss = loss
        self.rating: Any = rating
        like = rating.beta
        self.tuned = None if tuned is None or all(tuned) else torch.tensor(list(map(bool, tuned)), device=like.device)
        self.phi = nn.Parameter(self.start().to(like))
        self.optimizer = optimizer([self.phi])
        if not isinstance(self.optimizer, torch.optim.Optimizer):
            raise TypeError(f"optimizer must make an Optimizer of torch, it made {shown(self.optimizer)}")
        self._write()

    def start(self) -> Tensor:
        """Start value of phi, a scalar, or ``[S]`` with members. Default: 0."""
        return torch.zeros_like(self.rating.beta)

    def slope(self, evidence: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
        """The objective and its derivative with respect to phi, a scalar or ``[S]`` each, without graph.

        Args:
            evidence: what the rating gave as such, ``[*B]``.
            batch: gives means over it.
        """
        raise NotImplementedError

    def write(self, keep: Callable[[Tensor, Tensor], Tensor]) -> None:
        """Writes the setting that phi stands for into the rating.

        Args:
            keep: of a new and an old value, ``[*S]``, the one to write.
        """
        raise NotImplementedError

    @torch.no_grad()
    def _write(self) -> None:
        self.write(lambda new, old: new if self.tuned is None else new.where(self.tuned, old))

    def step(self, evidence: Tensor | None = None) -> Tensor:
        """One step of the tuner.

        Args:
            evidence: of a batch, ``[N]``; ``[S, N]`` with members. Default: that of the loss's last ``forward`` in
                training mode.

        Returns:
            The objective before the step, a detached scalar; ``[S]`` with members, 0 where nothing is tuned.
        """
        if evidence is None:
            evidence, batch = self.loss.last_evidence
        else:
            evidence, batch = evidence.detach(), self.loss.batch_of(None)
        with torch.no_grad():
            objective, slope = self.slope(evidence, batch)
            if self.tuned is not None:
                objective, slope = objective.where(self.tuned, 0.0), slope.where(self.tuned, 0.0)
        self.phi.grad = slope
        self.optimizer.step()
        self._write()
        return objective

    def __call__(self) -> None:
        """The trainer's hook: one step."""
        self.step()

    def register(self, trainer: Trainer, name: str | None = None) -> None:
        """Registers the tuner after each optimizer step, and for checkpoints.

        Args:
            trainer: TorchRL's.
            name: in its checkpoints. Default: that of the class, such as ``"q_tuner"``.
        """
        trainer.register_op("post_optim", self)
        trainer.register_module(name or self.name, self)

    #: Name in checkpoints.
    name: str = "tuner"

    def state_dict(self) -> dict[str, Any]:
        """State: phi and its optimizer's."""
        return {"phi": self.phi.detach().clone(), "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores the state and writes the setting into the rating."""
        with torch.no_grad():
            self.phi.copy_(state_dict["phi"])
        self.optimizer.load_state_dict(state_dict["optimizer"])
        self._write()
