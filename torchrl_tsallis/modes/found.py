"""What was found: modes, how sure they are, and which one to imitate."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchrl_tsallis.modes.consensus import adjusted_rand_index


@dataclass(frozen=True)
class Modes:
    """Modes of behaviour among demonstrations.

    Args:
        groups: episodes of each mode; the largest mode first. An episode that no mode shares is a group of its own.
        pairs: how often two episodes were of one component, over the starts, ``[E, E]``.
        starts: component of each episode in each start, ``[K, E]``.
        one: log-likelihood a step of each held-out episode under policies that all have the same data, ``[E]``.
        several: the same under a mixture, ``[E]``.
    """

    groups: tuple[tuple[int, ...], ...]
    pairs: Tensor
    starts: Tensor
    one: Tensor
    several: Tensor

    @property
    def gain(self) -> Tensor:
        """By how many nats a step the mixture explains each held-out episode better, ``[E]``."""
        return self.several - self.one

    @property
    def agreement(self) -> float:
        """Mean adjusted Rand index between the starts; 1 with one mode."""
        if len(self.groups) == 1:
            return 1.0
        found = [adjusted_rand_index(a, b) for k, a in enumerate(self.starts) for b in self.starts[k + 1 :]]
        return sum(found) / len(found) if found else 1.0

    @property
    def of_episodes(self) -> Tensor:
        """Number of each episode's mode, ``[E]``."""
        out = torch.empty(len(self.pairs), dtype=torch.int64)
        for number, group in enumerate(self.groups):
            out[list(group)] = number
        return out

    @property
    def membership(self) -> Tensor:
        """How often an episode is of one component with the others of a mode, over the starts, ``[K, E]``."""
        if len(self.groups) == 1:
            return torch.ones(1, len(self.pairs), dtype=torch.float64)
        apart = self.pairs.double().clone().fill_diagonal_(0.0)
        out = torch.zeros(len(self.groups), len(apart), dtype=torch.float64)
        for number, group in enumerate(self.groups):
            own = list(group)
            others = torch.full((len(apart),), float(len(own)), dtype=torch.float64)
            others[own] -= 1
            out[number] = apart[own].sum(0) / others.clamp_min(1)
        return out

    @property
    def share(self) -> Tensor:
        """Share of the episodes that each mode has, ``[K]``."""
        return torch.tensor([len(group) for group in self.groups]).double() / len(self.pairs)

    @property
    def certainty(self) -> Tensor:
        """Mean membership of each mode's own episodes, ``[K]``; 0 for an episode alone."""
        member = self.membership
        return torch.stack([member[k, list(group)].mean() for k, group in enumerate(self.groups)])

    @property
    def recommended(self) -> int:
        """The mode to imitate where nothing is known of returns: the largest share times certainty."""
        return int((self.share * self.certainty).argmax())


def signed_rank(value: Tensor) -> float:
    r"""How sure it is that values lie above 0: Wilcoxon's signed-rank statistic, standardised.

    .. math:: z = \frac{W_+ - n (n + 1) / 4}{\sqrt{n (n + 1) (2 n + 1) / 24}}

    with the sum :math:`W_+` of the ranks that the positive ones of n values have by size. No single value decides,
    which a mean of few, unequal episodes would let happen.

    Source: Wilcoxon, "Individual Comparisons by Ranking Methods", Biometrics Bulletin 1(6), 1945.

    Args:
        value: ``[n]``. Equal sizes have their mean rank; zeros are left out.

    Returns:
        z, about normal if values are as often above 0 as below; 0 where there is no value.

    Examples:
        >>> round(signed_rank(torch.tensor([1.0, 2.0, -3.0, 4.0])), 4)  # (1 + 2 + 4 - 5) / sqrt(7.5)
        0.7303
    """
    value = value[value != 0].double()
    n = len(value)
    if not n:
        return 0.0
    size = value.abs()
    rank = (size[:, None] > size).sum(1) + ((size[:, None] == size).sum(1) + 1) / 2
    positive = float(rank[value > 0].sum())
    return (positive - n * (n + 1) / 4) / (n * (n + 1) * (2 * n + 1) / 24) ** 0.5
