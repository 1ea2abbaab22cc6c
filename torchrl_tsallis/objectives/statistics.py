"""Batch statistics of the rating that are logged beside the loss."""

from __future__ import annotations

import torch
from torch import Tensor


def rating_statistics(weights: Tensor, mask: Tensor | None = None) -> dict[str, Tensor]:
    r"""Mean, variance and effective sample size of the ratings of a batch.

    .. math:: \mathrm{ess} = \left(\sum_i \rho_i\right)^2 / \sum_i \rho_i^2

    Args:
        weights: ratings, ``[*B]``, not negative.
        mask: valid samples, ``[*B]`` bool. Default: all of them.

    Returns:
        ``rating_mean``, ``rating_var`` (biased) and ``ess`` (in samples; 0 if every weight is 0), scalars.

    Examples:
        >>> {k: round(v.item(), 4) for k, v in rating_statistics(torch.tensor([1.0, 1.0, 0.0, 0.0])).items()}
        {'rating_mean': 0.5, 'rating_var': 0.25, 'ess': 2.0}
    """
    # Squares of ratings of up to exp(64) leave float32's range, not float64's.
    wide = weights.double()
    count: Tensor | int = weights.numel()
    if mask is not None:
        wide = torch.where(mask, wide, 0.0)
        count = mask.sum().clamp_min(1)
    total = wide.sum()
    squares = wide.square().sum()
    mean = total / count
    ess = total.square() / squares.clamp_min(torch.finfo(wide.dtype).tiny)
    var = (squares / count - mean.square()).clamp(0, torch.finfo(weights.dtype).max)
    return {"rating_mean": mean.to(weights.dtype), "rating_var": var.to(weights.dtype), "ess": ess.to(weights.dtype)}
