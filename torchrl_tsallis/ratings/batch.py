"""Means and sums over a batch, whatever its mask, its stacked members and the processes that share it."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchrl_tsallis.ratings.distributed import GlobalSum, global_sum, num_processes


def per_sample(value: Tensor, samples: Tensor) -> Tensor:
    """Shapes one value per member so that it broadcasts over the member's samples.

    Args:
        value: ``[*S]``, or a scalar, which broadcasts as it is.
        samples: ``[*S, *B]``.

    Returns:
        A view of ``value``, ``[*S, 1, ...]``.

    Examples:
        >>> per_sample(torch.ones(3), torch.ones(3, 4, 5)).shape
        torch.Size([3, 1, 1])
    """
    return value[(...,) + (None,) * (samples.ndim - value.ndim)] if value.ndim else value


class Batch:
    """What a mean over "the batch" means: which samples are valid, whose they are, and who else has some.

    The one place that knows of masks, stacked members and data-parallel processes; a rating or a tuner asks it for
    means and is right in all of these cases.

    Args:
        mask: valid samples, ``[*B]`` bool; what the others hold is selected away and may be NaN. Default: None, all.
        members: whether the first dimension is that of stacked members, which have means of their own.
        total: sums over the processes of data-parallel training. Default: None, there is only one.
        num_processes: how many there are.

    Examples:
        >>> batch = Batch(torch.tensor([[True, True], [True, False]]), members=True)
        >>> batch.mean(torch.tensor([[1.0, 3.0], [5.0, torch.nan]]))
        [tensor([2., 5.])]
    """

    def __init__(
        self,
        mask: Tensor | None = None,
        *,
        members: bool = False,
        total: GlobalSum | None = None,
        num_processes: int = 1,
    ) -> None:
        self.mask = mask
        self.members = members
        self.total = total
        self.num_processes = num_processes
        self.count: Tensor | None = None

    @classmethod
    def of(cls, mask: Tensor | None, members: bool, sync: bool, group: Any = None) -> Batch:
        """The batch of a loss: of all processes of a group where ``torch.distributed`` is initialised and ``sync``."""
        processes = num_processes(group) if sync else 1
        total = partial(global_sum, group=group) if processes > 1 else None
        return cls(mask, members=members, total=total, num_processes=processes)

    def sum(self, x: Tensor) -> Tensor:
        """Sum over this process's valid samples ``[*B]``, a scalar, or ``[S]`` with members."""
        if self.mask is not None:
            x = x.where(self.mask, 0.0)
        return x.flatten(1).sum(1) if self.members else x.sum()

    def local_mean(self, x: Tensor) -> Tensor:
        """Mean over this process's valid samples ``[*B]``, a scalar, or ``[S]``; 0 where no sample is valid."""
        if self.mask is None:
            return x.flatten(1).mean(1) if self.members else x.mean()
        return self.sum(x) / self.sum(self.mask).clamp_min(1)

    def mean(self, *values: Tensor) -> list[Tensor]:
        """Means over the valid samples of all processes, for one communication.

        Args:
            values: each ``[*B]``.

        Returns:
            The means, scalars, or ``[S]`` with members; 0 where no sample is valid.
        """
        if self.total is None:
            return [self.local_mean(value) for value in values]
        every = torch.ones_like(values[0], dtype=torch.bool) if self.mask is None else self.mask
        *sums, self.count = self.total(*map(self.sum, values), self.sum(every))
        return [value / self.count.clamp_min(1).to(value) for value in sums]

    def share_of_mean(self, x: Tensor) -> Tensor:
        """A term of which the average over the processes is the mean over all their samples, a scalar or ``[S]``.

        ``DistributedDataParallel`` averages gradients; where a mask leaves the processes unequal numbers of samples,
        the average of their means would not be the mean over all samples.
        """
        if self.total is None:
            return self.local_mean(x)
        if self.count is None:
            self.mean(x.detach())
        assert self.count is not None
        return self.sum(x) * (self.num_processes / self.count.clamp_min(1)).to(x)

    def spread(self, value: Tensor, samples: Tensor) -> Tensor:
        """One value a member, ``[S]``, so that it broadcasts over ``samples``; a scalar as it is."""
        return per_sample(value, samples)

    def valid(self, samples: Tensor) -> Tensor:
        """The samples with NaN where the mask leaves them out, ``[*B]``: never a plausible number."""
        return samples if self.mask is None else samples.where(self.mask, torch.nan)


def rating_statistics(weights: Tensor, batch: Batch | None = None) -> dict[str, Tensor]:
    r"""Mean, variance and effective sample size of the ratings of a batch.

    .. math:: \mathrm{ess} = \left(\sum_i \rho_i\right)^2 / \sum_i \rho_i^2

    Args:
        weights: ratings, ``[*B]``; not negative.
        batch: its valid samples, members and processes. Default: one policy's, all of them.

    Returns:
        ``rating_mean``, ``rating_var`` (biased) and ``ess`` (in samples; 0 if every weight is 0), scalars, or ``[S]``
        with members.

    Examples:
        >>> {k: round(v.item(), 4) for k, v in rating_statistics(torch.tensor([1.0, 1.0, 0.0, 0.0])).items()}
        {'rating_mean': 0.5, 'rating_var': 0.25, 'ess': 2.0}
    """
    batch = batch or Batch()
    # Squares of ratings of up to exp(64) leave float32's range, not float64's.
    wide = weights.double().flatten(int(batch.members))
    count: Tensor | int = wide.shape[-1]
    if batch.mask is not None:
        mask = batch.mask.flatten(int(batch.members))
        wide = wide.where(mask, 0.0)
        count = mask.sum(-1).clamp_min(1)
    ratings, squares = wide.sum(-1), wide.square().sum(-1)
    if batch.total is not None:
        counts = torch.as_tensor(count, device=wide.device).expand_as(ratings)
        ratings, squares, count = batch.total(ratings, squares, counts)
        count = count.clamp_min(1)
    mean = ratings / count
    ess = ratings.square() / squares.clamp_min(torch.finfo(wide.dtype).tiny)
    var = (squares / count - mean.square()).clamp(0, torch.finfo(weights.dtype).max)
    return {"rating_mean": mean.to(weights.dtype), "rating_var": var.to(weights.dtype), "ess": ess.to(weights.dtype)}
