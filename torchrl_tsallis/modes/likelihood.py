"""How well policies explain whole episodes, so that no single step decides."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_tsallis.ratings.normal import DiagonalNormal, squared_distance

#: Squared distances beyond so many times the action's dimensions count no more.
CUT = 6.0


def robust_log_prob(normal: DiagonalNormal) -> Tensor:
    r"""Log-density of a diagonal normal whose squared distance is cut, up to a constant.

    .. math:: \ell = -\tfrac{1}{2} \min(Z, 6 A) - \sum_i \ln s_i, \qquad Z = \sum_i \frac{(a_i - \mu_i)^2}{s_i^2}

    One step that a policy did not expect costs at most 3 A nats, so that the mean over an episode says what most of its
    steps say.

    Args:
        normal: at the actions, ``[*B, A]``.

    Returns:
        :math:`\ell`, ``[*B]``, without gradient.

    Examples:
        >>> one = torch.ones(1, 2)
        >>> robust_log_prob(DiagonalNormal(9 * one, one, 2 * one))  # Z = 32, cut at 12; 2 ln 2
        tensor([-7.3863])
    """
    dims = normal.scale.shape[-1]
    with torch.no_grad():
        return -0.5 * squared_distance(normal).clamp(max=CUT * dims) - normal.scale.log().sum(-1)


def episode_means(value: Tensor, episode: Tensor, count: int) -> Tensor:
    """Means over the rows of each episode, in float64.

    Args:
        value: ``[*S, N]``.
        episode: number of each row's episode, ``[N]``.
        count: number E of episodes; each has a row.

    Returns:
        ``[*S, E]``.

    Examples:
        >>> episode_means(torch.tensor([1.0, 3.0, 5.0]), torch.tensor([0, 0, 1]), 2)
        tensor([2., 5.], dtype=torch.float64)
    """
    rows = torch.bincount(episode, minlength=count)
    total = value.new_zeros(*value.shape[:-1], count, dtype=torch.float64)
    return total.index_add_(-1, episode, value.double()) / rows
