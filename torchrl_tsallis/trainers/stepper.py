"""The guarded step of the optimizer: of a single policy, or of stacked ones that must not touch each other."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.trainers import OptimizationStepper, Trainer

from torchrl_tsallis._checks import check_number
from torchrl_tsallis._torchrl import optim_steps


def guard_grads(params: list[Tensor], losses: Tensor, clip_norm: float | None = None) -> tuple[Tensor, Tensor]:
    """Clips the gradient, and marks it by NaN where it or the loss is not finite; for each member by itself.

    Args:
        params: parameters; of stacked members ``[S, ...]``.
        losses: the loss, a scalar; of stacked members ``[S]``.
        clip_norm: largest norm of the gradient, of each member. Default: None.

    Returns:
        The norm of the gradient before clipping, and whether it and the loss are finite; of the losses' shape.

    Raises:
        RuntimeError: if no parameter has a gradient.

    Examples:
        >>> weight = torch.nn.Parameter(torch.zeros(2, 3))
        >>> weight.grad = torch.tensor([[3.0, 4.0, 0.0], [1.0, float("inf"), 0.0]])
        >>> guard_grads([weight], torch.zeros(2), clip_norm=1.0)
        (tensor([5., inf]), tensor([ True, False]))
        >>> weight.grad
        tensor([[0.6000, 0.8000, 0.0000],
                [   nan,    nan,    nan]])
    """
    grads = [p.grad for p in params if p.grad is not None]
    if not grads:
        raise RuntimeError("no parameter of the optimizer has a gradient: make it of loss.parameters()")
    dims = losses.ndim  # 0, or 1 with members
    norms = torch.stack([torch.linalg.vector_norm(g.flatten(dims), dim=-1) for g in grads])
    norm = norms.square().sum(0).sqrt() if dims else torch.linalg.vector_norm(norms)
    good = norm.isfinite() & losses.isfinite()
    if clip_norm is not None:
        scale = (clip_norm / (norm + 1e-6)).clamp(max=1.0)  # as torch.nn.utils.clip_grad_norm_
        for g in grads:
            g.mul_(scale.view(*scale.shape, *[1] * (g.ndim - dims)))
    if not good.all():
        for g in grads:
            g[~good] = torch.nan
    return norm, good


class GuardedStepper(OptimizationStepper):
    """TorchRL's optimization step that leaves a non-finite step out, and gives up after too many in a row.

    The sum of everything that the loss returns under a name with ``loss_`` is minimised. Of stacked members, the ones
    with a non-finite loss or gradient are left out alone: their gradient becomes NaN as a whole, for which
    ``AdaTerm(batch_dims=1)`` leaves the member and its state as they are. An optimizer that does not skip NaN would
    lose that member, and no other.

    Args:
        max_skips: steps in a row that may be skipped (10).

    Raises:
        ValueError: if ``max_skips`` is negative or no integer (``TypeError``).
        FloatingPointError: in :meth:`step`, after more than ``max_skips`` skipped steps in a row. The policy is as it
            was before them.
    """

    def __init__(self, max_skips: int = 10) -> None:
        super().__init__()
        self.max_skips = int(check_number("max_skips", max_skips, low=0, integer=True))
        self.skipped: Tensor | None = None
        self.in_a_row = 0

    def step(self, trainer: Trainer, sub_batch: TensorDictBase) -> TensorDictBase:
        """One step of the optimizer; the returned losses are detached, or their graphs would pile up."""
        optimizer = trainer.optimizer
        losses = trainer.compute_loss(sub_batch)
        total = sum(value for key, value in losses.items() if key.startswith("loss"))
        total.backward()
        out = losses.detach()
        if getattr(trainer.loss_module, "_compiled_call_impl", None) is not None:
            out = out.clone()  # a program of CUDA graphs writes the next step's losses over these
        params = [p for group in optimizer.param_groups for p in group["params"]]
        norm, good = guard_grads(params, out.get("member_loss", total.detach()), trainer.clip_norm)
        any_good = bool(good.any())
        if any_good:
            optimizer.step()
        optimizer.zero_grad()
        self.in_a_row = 0 if any_good else self.in_a_row + 1
        if self.in_a_row > self.max_skips:
            raise FloatingPointError(
                f"{self.in_a_row} steps in a row up to step {optim_steps(trainer)} had a loss or gradient that is not "
                f"finite (loss {total.item()}, largest gradient norm {norm.max().item()}): check the data by "
                "validate_demonstrations, or lower the learning rate; the policy is as it was before them"
            )
        skipped = torch.zeros_like(norm) if self.skipped is None else self.skipped.to(norm)
        self.skipped = skipped + ~good
        out["grad_norm"] = norm
        out["skipped_steps"] = self.skipped
        return out

    def state_dict(self) -> dict[str, Any]:
        """Counts of skipped steps."""
        return {"skipped": self.skipped, "in_a_row": self.in_a_row}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores the counts."""
        skipped = state_dict["skipped"]
        self.skipped = None if skipped is None else torch.as_tensor(skipped, dtype=torch.get_default_dtype())
        self.in_a_row = int(state_dict["in_a_row"])
