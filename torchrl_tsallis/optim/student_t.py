"""Moving averages that are robust to outliers by Student's t: the part that AdaTerm and CAT-soft share.

Source: Ilboudo, Kobayashi & Matsubara, "AdaTerm: Adaptive T-distribution Estimated Robust Moments for Noise-Robust
Stochastic Gradient Optimization", Neurocomputing 2023, arXiv 2201.06714; in this project's reading.

All functions are elementwise in scalars that belong to one tensor (or to one ensemble member's tensor) each; any
number of them is stacked in one tensor, so that the cost does not depend on how many there are.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

__all__ = ["floor_target", "robust_rate"]

_TINY = torch.finfo(torch.float32).tiny


def robust_rate(distance: Tensor, nu: Tensor, rate_nu: float, k: float, eps: float) -> tuple[Tensor, Tensor]:
    r"""Share of the moving average's rate that a sample gets, and the next degrees of freedom.

    With the weight ``w = (nu + 1) / (nu + D)`` and that of distance 0, ``w_max = (nu + 1) / nu``::

        share = w / w_max;  nu += t_nu (nu* - nu)
        t_nu = rate_nu w_nu / w_nu_max;  w_nu = w - ln w;  w_nu_max = max(w_max - ln w_max, -ln(smallest normal number))
        nu* = ((nu+2)/(nu+1) + nu) / w_nu * (1 - k/nu) + k + eps

    The smallest normal number is float32's, 2^-126, for every data type: it is a constant of the rule, and with
    float64's own the degrees of freedom would move eight times more slowly in float64 than in float32. No weight is
    less than it, so that ``t_nu`` never exceeds its rate.

    Args:
        distance: mean squared normalised distance ``D``, of any shape; infinite is allowed.
        nu: degrees of freedom, of the same shape.
        rate_nu: rate of the degrees of freedom, in [0, 1]; 0 keeps them.
        k: lower bound of the degrees of freedom; infinite switches the robustness off (share 1, ``nu`` unchanged).
        eps: margin over the bound.

    Returns:
        The share in (0, 1] and the new degrees of freedom, of the same shape each.

    Examples:
        >>> share, nu = robust_rate(torch.tensor([0.0, 3.0]), torch.ones(2), rate_nu=0.1, k=1.0, eps=0.0)
        >>> share
        tensor([1.0000, 0.2500])
    """
    if math.isinf(k):
        return torch.ones_like(nu), nu
    one_more = nu + 1
    weight = (one_more / (nu + distance)).clamp_(min=_TINY)
    largest = one_more / nu
    w_nu = weight - weight.log()
    w_nu_max = (largest - largest.log()).clamp_(min=-math.log(_TINY))
    # w_nu (nu* - nu), with (nu + 2) / (nu + 1) + nu = (nu + 1) + 1 / (nu + 1)
    pull = one_more.add_(one_more.reciprocal()).mul_(1 - k / nu).addcmul_(w_nu, (k + eps) - nu)
    return weight.div_(largest), torch.addcdiv(nu, pull, w_nu_max, value=rate_nu)


def floor_target(d2: Tensor, variance: Tensor, distance: Tensor, inverse_nu: Tensor, eps: float) -> Tensor:
    r"""Value the variance's floor moves to, ``max(eps^2, (d2 - D v) / nu)``.

    Args:
        d2: squared differences, of any shape.
        variance: ``v``, of the same shape.
        distance: ``D``, that broadcasts to the same shape.
        inverse_nu: ``1 / nu``, likewise; 0 gives ``eps^2``.
        eps: square root of the least floor.

    Returns:
        The target, of the same shape, finite.

    Examples:
        >>> one = torch.ones(2)
        >>> floor_target(torch.tensor([3.0, 0.0]), one, one, one, eps=0.5)
        tensor([2.0000, 0.2500])
    """
    excess = torch.addcmul(d2, distance, variance, value=-1).clamp_(min=0)
    return excess.mul_(inverse_nu).clamp_(eps**2, torch.finfo(d2.dtype).max / 16)
