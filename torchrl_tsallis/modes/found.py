"""What was found: modes, how sure they are, and which one to imitate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from torchrl_tsallis._checks import check_number
from torchrl_tsallis.modes.consensus import adjusted_rand_index, consensus
from torchrl_tsallis.modes.separation import SEPARATED, best_split, cut, separated, silhouettes

#: Least share of starts in which the episodes of a mode are together, and least agreement between starts (of which 0 is
#: chance) for more than one mode; measured, see docs/modes.md.
TOGETHER, AGREE = 0.5, 0.2
#: What modes are found by.
By = Literal["distributions", "policies"]


@dataclass(frozen=True)
class Modes:
    """Modes of behaviour among demonstrations.

    Args:
        groups: episodes of each mode; the largest mode first. An episode that no mode shares is a group of its own.
        pairs: how close two episodes are, ``[E, E]`` in [0, 1].
        membership: how clearly an episode is of its mode, ``[E]`` in [0, 1]; 0 for an episode alone, 1 where there is
            one mode.
        evidence: for more than one mode: the mean silhouette of the best split (distributions), or the mean agreement
            of the starts (policies).
        by: what they were found by, ``"distributions"`` or ``"policies"``.
    """

    groups: tuple[tuple[int, ...], ...]
    pairs: Tensor
    membership: Tensor
    evidence: float
    by: By

    @classmethod
    def of_distances(cls, distances: Tensor, *, least: float = SEPARATED, count: int | None = None) -> Modes:
        """The modes that lie apart.

        Args:
            distances: of episodes, ``[E, E]``.
            least: mean silhouette of a split.
            count: of modes, whether they lie apart or not. Default: as many as do.

        Examples:
            >>> place = torch.tensor([0.0, 1.0, 10.0, 11.0])
            >>> found = Modes.of_distances((place[:, None] - place).abs())
            >>> found.groups, [round(value, 2) for value in found.membership.tolist()]
            (((0, 1), (2, 3)), [0.9, 0.89, 0.89, 0.9])
        """
        groups = separated(distances, least) if count is None else cut(distances, count)
        member = torch.ones(len(distances), dtype=torch.float64)
        if len(groups) > 1:
            member = silhouettes(distances, groups).clamp_min(0).double()
        pairs = 1 - distances / distances.max().clamp_min(torch.finfo(distances.dtype).tiny)
        return cls(tuple(map(tuple, groups)), pairs, member, best_split(distances)[0], "distributions")

    @classmethod
    def of_starts(cls, pairs: Tensor, starts: Tensor, *, threshold: float = TOGETHER, always: bool = False) -> Modes:
        """The modes that starts agree on, or one where they agree by no more than chance would let them.

        Args:
            pairs: how often two episodes were of one component, ``[E, E]``.
            starts: component of each episode in each start, ``[K, E]``; two or more.
            threshold: least share of starts in which the episodes of a mode are together.
            always: whether modes are what the starts agree on, however little that is.
        """
        check_number("threshold", threshold, above=0, high=1)
        found = [adjusted_rand_index(a, b) for k, a in enumerate(starts) for b in starts[k + 1 :]]
        agreement = sum(found) / len(found)
        groups = consensus(pairs, threshold) if always or agreement >= AGREE else [list(range(len(pairs)))]
        member = torch.ones(len(pairs), dtype=torch.float64)
        if len(groups) > 1:
            apart = pairs.double().clone().fill_diagonal_(0.0)
            for own in groups:
                member[own] = apart[own][:, own].sum(1) / max(1, len(own) - 1)
        return cls(tuple(map(tuple, groups)), pairs, member, agreement, "policies")

    @property
    def of_episodes(self) -> Tensor:
        """Number of each episode's mode, ``[E]``."""
        out = torch.empty(len(self.pairs), dtype=torch.int64)
        for number, group in enumerate(self.groups):
            out[list(group)] = number
        return out

    @property
    def share(self) -> Tensor:
        """Share of the episodes that each mode has, ``[K]``."""
        return torch.tensor([len(group) for group in self.groups]).double() / len(self.pairs)

    @property
    def certainty(self) -> Tensor:
        """Mean membership of each mode's episodes, ``[K]``; 0 for an episode alone."""
        return torch.stack([self.membership[list(group)].mean() for group in self.groups])

    @property
    def recommended(self) -> int:
        """The mode to imitate where nothing is known of returns: the largest share times certainty."""
        return int((self.share * self.certainty).argmax())
