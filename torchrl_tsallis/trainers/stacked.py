"""Training of stacked members by the offline trainer: a guard that keeps them apart, and their logs."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.trainers import OptimizationStepper, Trainer, TrainerHookBase


def guard_member_grads(params: list[Tensor], losses: Tensor, clip_norm: float | None = None) -> tuple[Tensor, Tensor]:
    """Clips each member's gradient, and marks those of the members whose loss or gradient is not finite by NaN.

    Args:
        params: stacked parameters, ``[S, ...]``.
        losses: loss of each member, ``[S]``.
        clip_norm: largest norm of a member's gradient. Default: None.

    Returns:
        The norm of each member's gradient before clipping, ``[S]``, and which of them are finite, ``[S]`` bool.

    Examples:
        >>> weight = torch.nn.Parameter(torch.zeros(2, 3))
        >>> weight.grad = torch.tensor([[3.0, 4.0, 0.0], [1.0, float("inf"), 0.0]])
        >>> guard_member_grads([weight], torch.zeros(2), clip_norm=1.0)
        (tensor([5., inf]), tensor([ True, False]))
        >>> weight.grad
        tensor([[0.6000, 0.8000, 0.0000],
                [   nan,    nan,    nan]])
    """
    grads = [p.grad for p in params if p.grad is not None]
    norm = torch.stack([torch.linalg.vector_norm(g.flatten(1), dim=1) for g in grads]).square().sum(0).sqrt()
    good = norm.isfinite() & losses.isfinite()
    if clip_norm is not None:
        scale = (clip_norm / (norm + 1e-6)).clamp(max=1.0)  # as torch.nn.utils.clip_grad_norm_
        for g in grads:
            g.mul_(scale.view(-1, *[1] * (g.ndim - 1)))
    if not good.all():
        for g in grads:
            g[~good] = torch.nan
    return norm, good


class MemberStepper(OptimizationStepper):
    """An optimization step of stacked members that leaves out those with a non-finite loss or gradient.

    The gradient of such a member becomes NaN as a whole, for which ``AdaTerm(batch_dims=1)`` leaves the member and its
    state as they are; the others go on. An optimizer that does not skip NaN would lose that member alone.

    Args:
        max_skips: steps in a row that may be skipped by all members.

    Raises:
        FloatingPointError: in :meth:`step`, after more than ``max_skips`` steps in a row without any finite member.
    """

    def __init__(self, max_skips: int = 10) -> None:
        super().__init__()
        if max_skips < 0:
            raise ValueError(f"max_skips must not be negative, got {max_skips}")
        self.max_skips = max_skips
        self.skipped: Tensor | None = None
        self.in_a_row = 0

    def step(self, trainer: Trainer, sub_batch: TensorDictBase) -> TensorDictBase:
        """One step of the optimizer; the returned losses are detached."""
        losses = trainer.compute_loss(sub_batch)
        losses["loss_tsallis_bc"].backward()
        out = losses.detach()
        params = [p for group in trainer.optimizer.param_groups for p in group["params"]]
        norm, good = guard_member_grads(params, out["member_loss"], trainer.clip_norm)
        if good.any():
            trainer.optimizer.step()
        self.in_a_row = 0 if good.any() else self.in_a_row + 1
        trainer.optimizer.zero_grad()
        if self.in_a_row > self.max_skips:
            raise FloatingPointError(
                f"{self.in_a_row} steps in a row up to step {trainer._optim_count} had no member with a finite loss "
                "and gradient: check the data by validate_demonstrations, or lower the learning rate"
            )
        self.skipped = (torch.zeros_like(norm) if self.skipped is None else self.skipped.to(norm)) + ~good
        out["grad_norm"] = norm
        out["skipped_steps"] = self.skipped
        return out

    def state_dict(self) -> dict[str, Any]:
        """Counts of skipped steps."""
        return {"skipped": self.skipped, "in_a_row": self.in_a_row}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores the counts."""
        self.skipped, self.in_a_row = state_dict["skipped"], int(state_dict["in_a_row"])


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
