"""Running means of batch statistics, frozen in evaluation."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor, nn


class RunningMean(nn.Module):
    """A statistic of the batch in training, and its running mean in evaluation, as batch normalisation has them.

    Args:
        momentum: weight of a new batch.
        start: what is used in evaluation before any batch was seen. Default: None, the batch at hand's, with a warning.

    Examples:
        >>> mean = RunningMean(momentum=0.5)
        >>> mean(torch.tensor(2.0)), mean(torch.tensor(4.0)), mean.eval()(torch.tensor(7.0))
        (tensor(2.), tensor(4.), tensor(3.))
    """

    value: Tensor
    batches: Tensor

    def __init__(self, momentum: float = 0.1, start: float | None = None) -> None:
        super().__init__()
        self.momentum = momentum
        self.start = start
        self.register_buffer("value", torch.full((), start or 0.0))
        self.register_buffer("batches", torch.zeros((), dtype=torch.int64))  # seen, that were finite

    def stack(self, num_members: int | None) -> None:
        """Makes room for the statistics of ``num_members`` stacked members, or of one policy."""
        self.value = self.value.new_full(() if num_members is None else (num_members,), self.start or 0.0)
        self.batches = torch.zeros_like(self.value, dtype=torch.int64)

    def forward(self, statistic: Tensor) -> Tensor:
        """Takes a batch's statistic in and gives it back; in evaluation gives the running mean.

        Args:
            statistic: a scalar, or ``[S]`` with members; without gradient.

        Returns:
            The statistic to use, of the same shape.
        """
        if not self.training:
            if self.start is not None or torch.compiler.is_compiling() or bool(self.batches.all()):
                return self.value.to(statistic)
            warnings.warn(
                "no batch was seen in training mode, so that the statistics are those of the batch at hand: call the "
                "loss on training batches first, or load its state",
                stacklevel=2,
            )
            return statistic
        if not torch._C._functorch.is_batchedtensor(statistic):  # under torch.vmap there is no one batch
            good = statistic.isfinite()
            rate = torch.where(self.batches == 0, 1.0, self.momentum)
            self.value.copy_(torch.where(good, self.value + rate * (statistic - self.value), self.value))
            self.batches.add_(good)
        return statistic
