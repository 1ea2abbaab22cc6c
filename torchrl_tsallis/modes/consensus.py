"""What several starts agree on: modes as groups of episodes that end up together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from torchrl_tsallis._checks import check_number


def together(starts: Sequence[Tensor]) -> Tensor:
    r"""How often two episodes are of one component, over the starts of a mixture.

    .. math:: M_{ij} = \frac{1}{K} \sum_k \sum_c r^k_{ci} r^k_{cj}

    Neither the order of the components nor their number has to be the same in all starts.

    Source: Fred & Jain, "Combining Multiple Clusterings Using Evidence Accumulation", IEEE TPAMI 27(6), 2005.

    Args:
        starts: responsibilities of each start, ``[C_k, E]``.

    Returns:
        ``[E, E]``, in [0, 1].

    Raises:
        ValueError: if there is no start, or they are of different episodes.

    Examples:
        >>> one, two = torch.tensor([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), torch.eye(3)
        >>> together([one, two])
        tensor([[1.0000, 0.5000, 0.0000],
                [0.5000, 1.0000, 0.0000],
                [0.0000, 0.0000, 1.0000]])
    """
    if not len(starts) or len({start.shape[-1] for start in starts}) != 1:
        raise ValueError(f"{len(starts)} starts were given: needed are responsibilities of the same episodes")
    return torch.stack([start.T @ start for start in starts]).mean(0)


def consensus(pairs: Tensor, threshold: float = 0.5) -> list[list[int]]:
    """Groups of episodes that are together in most starts, by average linkage.

    The two groups that are together most, on average over their pairs, are merged until none are more often together
    than not.

    Args:
        pairs: of :func:`together`, ``[E, E]``.
        threshold: least share of starts in which the episodes of two groups are together, in (0, 1].

    Returns:
        The groups' episodes, each ascending; the largest group first, of equal ones that with the first episode.

    Examples:
        >>> pairs = torch.eye(4)
        >>> pairs[0, 2] = pairs[2, 0] = 0.9
        >>> consensus(pairs)
        [[0, 2], [1], [3]]
    """
    check_number("threshold", threshold, above=0, high=1)
    *_, last = average_linkage(pairs, threshold)
    return sorted((sorted(group) for group in last), key=lambda group: (-len(group), group[0]))


def average_linkage(pairs: Tensor, threshold: float = -torch.inf) -> Iterator[list[list[int]]]:
    """Groups after each merge of the two that are closest, on average over their pairs, from each one alone to one.

    Args:
        pairs: how close two of them are, ``[E, E]``.
        threshold: two groups that are less close are not merged.

    Yields:
        The groups, the same list each time.
    """
    groups = [[i] for i in range(len(pairs))]
    sums = pairs.double().clone()  # over the pairs of two groups
    sizes = torch.ones(len(pairs), dtype=torch.float64)
    yield groups
    while len(groups) > 1:
        means = sums / sizes[:, None] / sizes[None]
        means.fill_diagonal_(-torch.inf)
        best = int(means.argmax())
        first, second = sorted(divmod(best, len(groups)))
        if means.view(-1)[best] < threshold:
            return
        groups[first] += groups.pop(second)
        keep = torch.arange(len(sizes)) != second
        sums[first] += sums[second]
        sums[:, first] += sums[:, second]
        sizes[first] += sizes[second]
        sums, sizes = sums[keep][:, keep], sizes[keep]
        yield groups


def adjusted_rand_index(first: Tensor, second: Tensor) -> float:
    """Agreement of two groupings beyond chance: 1 for the same groups whatever their names, 0 for chance.

    Source: Hubert & Arabie, "Comparing partitions", Journal of Classification 2, 1985.

    Args:
        first: group of each episode, ``[E]`` integers.
        second: of the other grouping.

    Returns:
        The index; 1 also where both are one group, or all groups of one.

    Examples:
        >>> adjusted_rand_index(torch.tensor([0, 0, 1, 1]), torch.tensor([5, 5, 2, 2]))
        1.0
        >>> round(adjusted_rand_index(torch.tensor([0, 0, 1, 1]), torch.tensor([0, 1, 0, 1])), 3)
        -0.5
    """
    _, a = first.unique(return_inverse=True)
    _, b = second.unique(return_inverse=True)
    table = torch.zeros(int(a.max()) + 1, int(b.max()) + 1, dtype=torch.float64)
    table.index_put_((a, b), torch.ones(len(a), dtype=torch.float64), accumulate=True)

    def pairs(counts: Tensor) -> float:
        return float((counts * (counts - 1) / 2).sum())

    same, rows, columns = pairs(table), pairs(table.sum(1)), pairs(table.sum(0))
    chance = rows * columns / max(pairs(torch.tensor([float(len(a))])), 1.0)
    most = (rows + columns) / 2
    return 1.0 if most == chance else (same - chance) / (most - chance)
