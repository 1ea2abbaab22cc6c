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

__all__ = ["floor_target", "max_weight", "nu_target", "robust_rate", "student_weight", "weight_entropy"]


def student_weight(distance: Tensor, nu: Tensor) -> Tensor:
    r"""Weight of a sample under Student's t, ``w = (nu + 1) / (nu + D)``.

    Args:
        distance: mean squared normalised distance ``D``, of any shape; infinite is allowed.
        nu: degrees of freedom, of the same shape.

    Returns:
        ``w``, of the same shape; at least the smallest normal number, so that its logarithm is finite.

    Examples:
        >>> student_weight(torch.tensor([0.0, 1.0, 3.0]), torch.ones(3))
        tensor([2.0000, 1.0000, 0.5000])
    """
    return ((nu + 1) / (nu + distance)).clamp(min=torch.finfo(nu.dtype).tiny)


def max_weight(nu: Tensor) -> Tensor:
    """Largest weight, ``w_max = (nu + 1) / nu``, that of distance 0.

    Args:
        nu: degrees of freedom, of any shape.

    Returns:
        ``w_max``, of the same shape.

    Examples:
        >>> max_weight(torch.tensor([1.0, 4.0]))
        tensor([2.0000, 1.2500])
    """
    return (nu + 1) / nu


def weight_entropy(weight: Tensor) -> Tensor:
    r"""``w_nu = w - ln w``, the statistic that drives the degrees of freedom; at least 1, its value at ``w = 1``.

    Args:
        weight: ``w > 0``, of any shape.

    Returns:
        ``w_nu``, of the same shape.

    Examples:
        >>> weight_entropy(torch.ones(1))
        tensor([1.])
    """
    return weight - weight.log()


def nu_target(w_nu: Tensor, nu: Tensor, k: float, eps: float) -> Tensor:
    r"""Value the degrees of freedom move to, ``nu* = ((nu+2)/(nu+1) + nu) / w_nu * (1 - k/nu) + k + eps``.

    Args:
        w_nu: :func:`weight_entropy` of the weight, of any shape.
        nu: degrees of freedom, of the same shape.
        k: their lower bound.
        eps: margin over the bound.

    Returns:
        ``nu*``, of the same shape.

    Examples:
        >>> nu_target(torch.ones(1), torch.full((1,), 2.0), k=1.0, eps=0.0)
        tensor([2.6667])
    """
    return ((nu + 2) / (nu + 1) + nu) / w_nu * (1 - k / nu) + k + eps


def robust_rate(distance: Tensor, nu: Tensor, rate_nu: float, k: float, eps: float) -> tuple[Tensor, Tensor]:
    r"""Share of the moving average's rate that a sample gets, and the next degrees of freedom.

    ``share = w / w_max`` and ``nu += t_nu (nu* - nu)`` with ``t_nu = rate_nu w_nu / w_nu_max`` and
    ``w_nu_max = max(w_max - ln w_max, -ln(smallest normal number))``.

    Args:
        distance: ``D``, of any shape.
        nu: degrees of freedom, of the same shape.
        rate_nu: rate of the degrees of freedom, in [0, 1].
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
    weight, largest = student_weight(distance, nu), max_weight(nu)
    w_nu = weight_entropy(weight)
    w_nu_max = weight_entropy(largest).clamp(min=-math.log(torch.finfo(nu.dtype).tiny))
    rate = rate_nu * w_nu / w_nu_max
    return weight / largest, nu + rate * (nu_target(w_nu, nu, k, eps) - nu)


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
