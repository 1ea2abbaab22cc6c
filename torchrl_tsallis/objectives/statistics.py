"""Batch statistics of the rating that are logged beside the loss."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrl_tsallis.objectives.distributed import GlobalSum


def masked_mean(x: Tensor, mask: Tensor | None = None, members: bool = False) -> Tensor:
    """Mean over the valid samples, of each member by itself where there are members.

    Args:
        x: ``[*B]``, or ``[S, *B]`` with members.
        mask: valid samples, bool, of the same shape; what it leaves out is selected away and may be NaN.
        members: whether the first dimension is that of the members.

    Returns:
        A scalar, or ``[S]``; 0 where no sample is valid.

    Examples:
        >>> masked_mean(torch.tensor([[1.0, 3.0], [5.0, 5.0]]), members=True)
        tensor([2., 5.])
    """
    if mask is None:
        return x.flatten(1).mean(1) if members else x.mean()
    x = x.where(mask, 0.0)
    if members:
        return x.flatten(1).sum(1) / mask.flatten(1).sum(1).clamp_min(1)
    return x.sum() / mask.sum().clamp_min(1)


def masked_sum(x: Tensor, mask: Tensor | None = None, members: bool = False) -> Tensor:
    """Sum over the valid samples; arguments and shapes as in :func:`masked_mean`.

    Examples:
        >>> masked_sum(torch.tensor([1.0, 3.0]), torch.tensor([True, False]))
        tensor(1.)
    """
    if mask is not None:
        x = x.where(mask, 0.0)
    return x.flatten(1).sum(1) if members else x.sum()


def global_means(
    values: Sequence[Tensor], mask: Tensor | None, members: bool, total: GlobalSum | None
) -> tuple[list[Tensor], Tensor | None]:
    """Means over the valid samples of all processes, for one communication.

    Args:
        values: each ``[*B]``, or ``[S, *B]`` with members.
        mask: as in :func:`masked_mean`.
        members: as in :func:`masked_mean`.
        total: sums over the processes; None where there is only one.

    Returns:
        The means, scalars or ``[S]``, and how many samples they are of, float64; None where there is one process.

    Examples:
        >>> global_means([torch.tensor([1.0, 3.0])], None, False, None)
        ([tensor(2.)], None)
    """
    if total is None:
        return [masked_mean(value, mask, members) for value in values], None
    every = torch.ones_like(values[0], dtype=torch.bool) if mask is None else mask
    *sums, count = total(*(masked_sum(value, mask, members) for value in values), masked_sum(every, None, members))
    return [value / count.clamp_min(1).to(value) for value in sums], count


def rating_statistics(
    weights: Tensor, mask: Tensor | None = None, members: bool = False, total: GlobalSum | None = None
) -> dict[str, Tensor]:
    r"""Mean, variance and effective sample size of the ratings of a batch.

    .. math:: \mathrm{ess} = \left(\sum_i \rho_i\right)^2 / \sum_i \rho_i^2

    Args:
        weights: ratings, ``[*B]``, or ``[S, *B]`` with members; not negative.
        mask: valid samples, bool, of the same shape. Default: all of them.
        members: whether the first dimension is that of the members, which have statistics of their own.
        total: sums over the processes of data-parallel training. Default: None, there is only one.

    Returns:
        ``rating_mean``, ``rating_var`` (biased) and ``ess`` (in samples; 0 if every weight is 0), scalars or ``[S]``.

    Examples:
        >>> {k: round(v.item(), 4) for k, v in rating_statistics(torch.tensor([1.0, 1.0, 0.0, 0.0])).items()}
        {'rating_mean': 0.5, 'rating_var': 0.25, 'ess': 2.0}
    """
    # Squares of ratings of up to exp(64) leave float32's range, not float64's.
    wide = weights.double().flatten(int(members))
    count: Tensor | int = wide.shape[-1]
    if mask is not None:
        mask = mask.flatten(int(members))
        wide = wide.where(mask, 0.0)
        count = mask.sum(-1).clamp_min(1)
    ratings, squares = wide.sum(-1), wide.square().sum(-1)
    if total is not None:
        ratings, squares, count = total(ratings, squares, torch.as_tensor(count, device=wide.device).expand_as(ratings))
        count = count.clamp_min(1)
    mean = ratings / count
    ess = ratings.square() / squares.clamp_min(torch.finfo(wide.dtype).tiny)
    var = (squares / count - mean.square()).clamp(0, torch.finfo(weights.dtype).max)
    return {"rating_mean": mean.to(weights.dtype), "rating_var": var.to(weights.dtype), "ess": ess.to(weights.dtype)}
