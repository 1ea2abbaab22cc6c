"""Running means of batch statistics, frozen in evaluation."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor, nn

from torchrl_tsallis.ratings.batch import Batch

_NO_BATCH = (
    "no batch was seen in training mode, so that the statistics are those of the batch at hand: call the "
    "loss on training batches first, or load its state"
)


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
            warnings.warn(_NO_BATCH, stacklevel=2)
            return statistic
        if not torch._C._functorch.is_batchedtensor(statistic):  # under torch.vmap there is no one batch
            good = statistic.isfinite()
            rate = torch.where(self.batches == 0, 1.0, self.momentum)
            self.value.copy_(torch.where(good, self.value + rate * (statistic - self.value), self.value))
            self.batches.add_(good)
        return statistic


class RunningScale(nn.Module):
    r"""Typical size of values that are not negative: a slow mean, weighted so that outliers do not move it.

    .. math:: m \leftarrow m + \kappa \left(\frac{\sum_i w_i \ell_i}{\sum_i w_i} - m\right)

    It starts from the first batch's geometric mean, which outliers move by the logarithm of their size alone.

    Args:
        rate: kappa, the weight of a new batch.

    Examples:
        >>> scale, batch = RunningScale(rate=0.5), Batch()
        >>> values, weights = torch.tensor([1.0, 100.0]), torch.tensor([1.0, 0.0])
        >>> scale(values, batch)
        tensor(10.)
        >>> scale.update(values, weights, batch)
        >>> scale.update(3 * values, weights, batch)
        >>> scale.eval()(values, batch)
        tensor(2.)
    """

    value: Tensor
    batches: Tensor

    def __init__(self, rate: float) -> None:
        super().__init__()
        self.rate = rate
        self.register_buffer("value", torch.zeros(()))
        self.register_buffer("batches", torch.zeros((), dtype=torch.int64))  # seen, that were finite

    @torch.no_grad()
    def forward(self, values: Tensor, batch: Batch) -> Tensor:
        """The scale to use for a batch; nothing is taken in.

        Args:
            values: ``[*B]``, not negative.
            batch: whose samples they are.

        Returns:
            The scale, a positive scalar.
        """
        range_ = torch.finfo(values.dtype)
        if not self.training and not torch.compiler.is_compiling():
            if bool(self.batches):
                return self.value.to(values).clamp_min(range_.tiny)
            warnings.warn(_NO_BATCH, stacklevel=2)
        (level,) = batch.mean(values.clamp(range_.tiny, range_.max).log())
        return torch.where(self.batches == 0, level.exp(), self.value.to(values)).clamp_min(range_.tiny)

    @torch.no_grad()
    def update(self, values: Tensor, weights: Tensor, batch: Batch) -> None:
        """Takes a batch in, in training mode; one that is not finite moves nothing.

        Args:
            values: ``[*B]``; may be infinite where the weight is 0.
            weights: ``[*B]``.
            batch: whose samples they are.
        """
        if not self.training or torch._C._functorch.is_batchedtensor(values):
            return
        share, total = batch.mean((weights * values).where(weights > 0, 0.0), weights)
        mean = (share / total).to(self.value)
        good = mean.isfinite()
        rate = torch.where(self.batches == 0, 1.0, self.rate)
        self.value.copy_(torch.where(good, self.value + rate * (mean - self.value), self.value))
        self.batches.add_(good)
