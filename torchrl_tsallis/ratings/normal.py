"""Diagonal normal distributions: standardised distances, scale-weighted likelihoods and surprises."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, Normal, TransformedDistribution, constraints

#: Squared distances are cut here, so that their squares still fit in float32.
MAX_DISTANCE = 1e9


class DiagonalNormal(NamedTuple):
    """A diagonal normal at some values, in the space where it is one.

    Attributes:
        value: the actions in that space, ``[*B, A]``.
        loc: ``[*B, A]``.
        scale: ``[*B, A]``.
    """

    value: Tensor
    loc: Tensor
    scale: Tensor


def diagonal_normal(dist: Distribution, action: Any) -> DiagonalNormal | None:
    """The diagonal normal that a distribution is, if it is one, also under a bijection such as tanh.

    Args:
        dist: batch shape ``[*B]``, event shape ``[A]``.
        action: ``[*B, A]``.

    Returns:
        Location, scale and the actions in the base space; None for any other distribution.

    Examples:
        >>> from torchrl.modules import TanhNormal
        >>> dist = TanhNormal(torch.zeros(5, 2), torch.ones(5, 2))
        >>> torch.round(diagonal_normal(dist, torch.full((5, 2), 0.5)).value[0], decimals=4)
        tensor([0.5493, 0.5493])
    """
    value = action
    while True:
        if isinstance(dist, Independent):
            dist = dist.base_dist
        elif isinstance(dist, TransformedDistribution):
            for transform in reversed(dist.transforms):
                if not transform.bijective:
                    return None
                value = transform.inv(value)
            dist = dist.base_dist
        elif type(dist) is Normal and isinstance(value, Tensor) and value.ndim and dist.support == constraints.real:
            return DiagonalNormal(value, dist.loc, dist.scale)
        else:
            return None


def squared_distance(normal: DiagonalNormal) -> Tensor:
    r"""Squared standardised distance, :math:`Z = \sum_i z_i^2` with :math:`z_i = (a_i - \mu_i) / s_i`.

    Args:
        normal: at the actions, ``[*B, A]``.

    Returns:
        Z, ``[*B]``, without gradient, at most :data:`MAX_DISTANCE`; NaN for an action that is.

    Examples:
        >>> one = torch.ones(1, 2)
        >>> squared_distance(DiagonalNormal(torch.tensor([[3.0, 1.0]]), one, 2 * one))
        tensor([1.])
    """
    with torch.no_grad():
        z = (normal.value - normal.loc) / normal.scale
        return torch.linalg.vector_norm(z, dim=-1).clamp(max=math.sqrt(MAX_DISTANCE)).square()


def scale_weighted_log_prob(normal: DiagonalNormal, beta: Tensor) -> Tensor:
    r"""Log-likelihood with each dimension multiplied by its own detached scale.

    .. math:: \sum_i \mathrm{sg}[s_i^{2\beta}] \ln N(a_i; \mu_i, s_i)

    A likelihood of states with different scales spends itself on those that fit easily; beta = 0.5 weighs the error of
    the mean about as the absolute error does, 1 as the squared one. Constants are left out.

    Source: Seitzer, Tavakoli, Antic & Martius, "On the Pitfalls of Heteroscedastic Uncertainty Estimation with
    Probabilistic Neural Networks", ICLR 2022 (beta-NLL).

    Args:
        normal: at the actions, ``[*B, A]``.
        beta: power, that broadcasts over ``[*B, A]``.

    Returns:
        The weighted log-likelihood up to a constant, ``[*B]``, with gradient. That of an action whose distance
        overflows is constant.

    Examples:
        >>> one = torch.ones(1, 2)
        >>> scale_weighted_log_prob(DiagonalNormal(2 * one, one, 4 * one), torch.tensor(0.5))
        tensor([-11.3404])
    """
    with torch.no_grad():
        # A distance that overflows has a rating of 0, and 0 * inf would be NaN in the gradient.
        far = ((normal.value - normal.loc) / normal.scale).abs() >= math.sqrt(MAX_DISTANCE)
        value = torch.where(far, normal.loc, normal.value)
        weight = normal.scale.pow(2 * beta)
    z = (value - normal.loc) / normal.scale
    return (weight * (-0.5 * z.square() - normal.scale.log())).sum(-1)


def surprise_of(distance: Tensor, dims: int, variance_share: Tensor) -> Tensor:
    r"""How unlikely a distance of at least this size is for good data, in decades.

    .. math:: -\log_{10} P(\chi^2_A \ge c Z)

    with c the fitted variance as a share of the true one, so that c Z is standardised by the true scale.

    Args:
        distance: Z, ``[*B]``.
        dims: A, the number of action dimensions.
        variance_share: c, that broadcasts.

    Returns:
        The surprise, ``[*B]``, which is 0 at the mean, 2 for one sample in a hundred, 6 for one in a million.

    Examples:
        >>> surprise_of(torch.tensor([0.0, 9.2103, 2000.0]), 2, torch.tensor(1.0))
        tensor([  0.0000,   2.0000, 434.2945])
    """
    a = torch.tensor(dims / 2, dtype=torch.float64, device=distance.device)
    x = (variance_share * distance).double() / 2
    near = torch.special.gammaincc(a, x).log()
    # The survival function leaves the range of float64; the continued fraction's first terms are its asymptote there.
    tail = x.clamp_min(1.0)
    far = (a - 1) * tail.log() - tail - torch.lgamma(a) - torch.log1p(-(a - 1) / (tail + 1))
    log_survival = torch.where(near > -600, near, far).clamp_max(0)
    return (log_survival / -math.log(10)).abs().to(distance.dtype)
