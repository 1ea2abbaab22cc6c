"""Groups that lie apart: how many there are, by how much nearer an episode is to its own than to any other."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_tsallis._checks import check_number
from torchrl_tsallis.modes.consensus import average_linkage

#: Least mean silhouette of a split: the next group is twice as far away as the own one; measured, see docs/modes.md.
SEPARATED = 0.5
#: From here on a split is no habit that varies without a gap: of places evenly spread on a line the halves have 0.63.
SURE = 0.65
#: Most groups of one split; larger numbers are found by splitting again.
MOST_GROUPS = 12


def silhouettes(distances: Tensor, groups: list[list[int]]) -> Tensor:
    r"""How much nearer an episode is to its own group than to the next one.

    .. math:: s_e = \frac{b_e - a_e}{\max(a_e, b_e)}

    :math:`a_e` is the mean distance to the others of its group, :math:`b_e` the least mean distance to another group.

    Source: Rousseeuw, "Silhouettes: a graphical aid to the interpretation and validation of cluster analysis", Journal
    of Computational and Applied Mathematics 20, 1987.

    Args:
        distances: ``[E, E]``.
        groups: of episodes, two or more; each episode is in one.

    Returns:
        ``[E]`` in [-1, 1]; 0 for an episode alone.

    Examples:
        >>> distances = torch.tensor([[0.0, 1.0, 4.0], [1.0, 0.0, 4.0], [4.0, 4.0, 0.0]])
        >>> silhouettes(distances, [[0, 1], [2]])
        tensor([0.7500, 0.7500, 0.0000])
    """
    own = torch.empty(len(distances), dtype=torch.int64)
    for k, group in enumerate(groups):
        own[group] = k
    sizes = torch.tensor([len(group) for group in groups])
    sums = torch.stack([distances[:, group].sum(1) for group in groups], 1)
    a = sums.gather(1, own[:, None])[:, 0] / (sizes[own] - 1).clamp_min(1)
    b = (sums / sizes).scatter(1, own[:, None], torch.inf).min(1).values
    most = torch.maximum(a, b)
    return torch.where((sizes[own] > 1) & (most > 0), (b - a) / most, torch.zeros_like(a))


def best_split(distances: Tensor) -> tuple[float, list[list[int]]]:
    """The number of groups by average linkage that has the largest mean silhouette.

    Args:
        distances: ``[E, E]``.

    Returns:
        The mean silhouette, and the groups; 0 and one group for fewer than three episodes.
    """
    best, split = 0.0, [list(range(len(distances)))]
    for groups in average_linkage(-distances):
        if 2 <= len(groups) <= MOST_GROUPS and len(groups) < len(distances):
            value = float(silhouettes(distances, groups).mean())
            if value >= best:  # of equal ones the fewest groups, which come last
                best, split = value, [list(group) for group in groups]
    return best, split


def separated(distances: Tensor, least: float = SEPARATED) -> list[list[int]]:
    """Groups of episodes that lie apart; one if there are none.

    Groups are merged by average linkage. Of all numbers of groups, that of the largest mean silhouette is taken if
    this is at least ``least``; each group is then split again in the same way, so that an episode far away does not
    hide how the others differ.

    Args:
        distances: ``[E, E]``.
        least: mean silhouette of a split, in (0, 1].

    Returns:
        The groups' episodes, each ascending; the largest group first, of equal ones that with the first episode.

    Examples:
        >>> place = torch.tensor([0.0, 1.0, 10.0, 11.0, 500.0])
        >>> separated((place[:, None] - place).abs())
        [[0, 1], [2, 3], [4]]
    """
    check_number("least", least, above=0, high=1)
    done, left = [], [list(range(len(distances)))]
    while left:
        episodes = left.pop()
        value, split = best_split(distances[episodes][:, episodes])
        if value < least:
            done.append(episodes)
        else:
            left += [[episodes[k] for k in group] for group in split]
    return sorted((sorted(group) for group in done), key=lambda group: (-len(group), group[0]))


def cut(distances: Tensor, count: int) -> list[list[int]]:
    """A given number of groups, by average linkage, whether they lie apart or not; the largest group first.

    Args:
        distances: ``[E, E]``.
        count: of groups, at most E.

    Examples:
        >>> place = torch.tensor([0.0, 1.0, 10.0, 11.0, 500.0])
        >>> cut((place[:, None] - place).abs(), 2)
        [[0, 1, 2, 3], [4]]
    """
    count = int(check_number("count", count, low=1, high=len(distances), integer=True))
    groups = next(groups for groups in average_linkage(-distances) if len(groups) == count)
    return sorted((sorted(group) for group in groups), key=lambda group: (-len(group), group[0]))
