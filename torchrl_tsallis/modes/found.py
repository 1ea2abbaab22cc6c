"""What was found: modes, how sure they are, and which one to imitate."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchrl_tsallis.modes.consensus import adjusted_rand_index, consensus

#: Least share of starts in which the episodes of a mode are together, and least agreement between starts (of which 0 is
#: chance) for more than one mode; measured, see docs/modes.md.
TOGETHER, AGREE = 0.5, 0.2


@dataclass(frozen=True)
class Modes:
    """Modes of behaviour among demonstrations.

    Args:
        groups: episodes of each mode; the largest mode first. An episode that no mode shares is a group of its own.
        pairs: how often two episodes were of one component, over the starts, ``[E, E]``.
        starts: component of each episode in each start, ``[K, E]``.
    """

    groups: tuple[tuple[int, ...], ...]
    pairs: Tensor
    starts: Tensor

    @classmethod
    def of(cls, pairs: Tensor, starts: Tensor, *, threshold: float = TOGETHER, always: bool = False) -> Modes:
        """The modes that starts agree on, or one where they agree by no more than chance would let them.

        Args:
            pairs: how often two episodes were of one component, ``[E, E]``.
            starts: component of each episode in each start, ``[K, E]``.
            threshold: least share of starts in which the episodes of a mode are together.
            always: whether modes are what the starts agree on, however little that is.
        """
        found = cls(tuple(map(tuple, consensus(pairs, threshold))), pairs, starts)
        return found if always or found.agreement >= AGREE else cls((tuple(range(len(pairs))),), pairs, starts)

    @property
    def agreement(self) -> float:
        """Mean adjusted Rand index between the starts: about 0 where each splits the episodes in a way of its own."""
        found = [adjusted_rand_index(a, b) for k, a in enumerate(self.starts) for b in self.starts[k + 1 :]]
        return sum(found) / len(found)

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
