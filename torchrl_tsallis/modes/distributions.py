"""How differently two episodes behave: distances between the distributions of what is seen and done in them."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_tsallis._checks import check_number

#: Levels at which distribution functions are compared.
LEVELS = 64
#: Rows that levels are made of, at most; evenly spread.
MOST_SORTED = 2**20


def behaviour(data: TensorDictBase, episode: Tensor) -> Tensor:
    """What an episode is judged by, a row a step: observation, action, and how much both changed since the last step.

    Args:
        data: ``observation`` ``[N, O]``, ``action`` ``[N, A]``.
        episode: number of each row's episode, ``[N]``; rows of an episode are side by side.

    Returns:
        ``[N, 2 (O + A)]``; the changes of an episode's first row are 0.

    Examples:
        >>> from tensordict import TensorDict
        >>> rows = {"observation": torch.tensor([[1.0], [4.0]]), "action": torch.tensor([[0.0], [2.0]])}
        >>> behaviour(TensorDict(rows, [2]), torch.zeros(2, dtype=torch.int64))
        tensor([[1., 0., 0., 0.],
                [4., 2., 3., 2.]])
    """
    now = torch.cat([data["observation"], data["action"]], -1)
    change = now.diff(dim=0, prepend=now[:1])
    starts = episode != episode.roll(1)
    starts[:1] = True
    return torch.cat([now, change.masked_fill(starts[:, None], 0.0)], -1)


def distribution_functions(values: Tensor, episode: Tensor, count: int, levels: int = LEVELS) -> Tensor:
    """Which share of an episode's rows is at most as large as each level, in each dimension.

    Levels are quantiles of all rows together, evenly spread, so that neither units nor outliers matter: a dimension may
    be replaced by any increasing function of itself.

    Args:
        values: ``[N, D]``.
        episode: number of each row's episode, ``[N]``.
        count: number E of episodes; each has a row.
        levels: L of a dimension.

    Returns:
        ``[E, D, L]`` float64, rising from 0 to 1.

    Examples:
        >>> values = torch.tensor([[1.0], [2.0], [3.0], [400.0]])
        >>> distribution_functions(values, torch.tensor([0, 0, 1, 1]), 2, levels=3)[:, 0]
        tensor([[0.5000, 1.0000, 1.0000],
                [0.0000, 0.0000, 0.5000]], dtype=torch.float64)
    """
    levels = int(check_number("levels", levels, low=1, integer=True))
    rows = torch.bincount(episode, minlength=count)
    some = values[:: max(1, -(-len(values) // MOST_SORTED))].sort(0).values
    # Level k of L has k / (L + 1) of the rows at or below it.
    at = some[(torch.arange(1, levels + 1) * len(some) + levels).div(levels + 1, rounding_mode="floor") - 1]
    out = torch.zeros(count, values.shape[1], levels, dtype=torch.float64)
    for dim in range(values.shape[1]):
        above = torch.bucketize(values[:, dim].contiguous(), at[:, dim].contiguous())  # levels that are smaller
        places = torch.bincount(episode * (levels + 1) + above, minlength=count * (levels + 1))
        out[:, dim] = places.view(count, levels + 1)[:, :levels].cumsum(1) / rows[:, None]
    return out


def areas_between(functions: Tensor) -> Tensor:
    r"""Area between the distribution functions of each two episodes, over ranks, the mean over dimensions.

    .. math:: D_{ij} = \frac{1}{d L} \sum_{k=1}^{d} \sum_{l=1}^{L} \left| F_{ik}(a_{kl}) - F_{jk}(a_{kl}) \right|

    This is the Wasserstein distance of order 1 where each dimension is replaced by its rank among all rows.

    Source: Vallender, "Calculation of the Wasserstein distance between probability distributions on the line", Theory
    of Probability and Its Applications 18(4), 1974.

    Args:
        functions: of :func:`distribution_functions`, ``[E, D, L]``.

    Returns:
        ``[E, E]`` in [0, 1]: 0 for equal distributions.

    Examples:
        >>> areas_between(torch.tensor([[[0.5, 1.0, 1.0]], [[0.0, 0.0, 0.5]]]))
        tensor([[0.0000, 0.6667],
                [0.6667, 0.0000]])
    """
    out = torch.stack([(functions - one).abs().mean((1, 2)) for one in functions])
    return (out + out.T) / 2
