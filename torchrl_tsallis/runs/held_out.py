"""Surprises and ratings of every row by the policies that did not see it, and by those that did."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_tsallis.data.episodes import Episodes
from torchrl_tsallis.ratings.normal import surprise_of
from torchrl_tsallis.runs.judgement import MOST_DECADES
from torchrl_tsallis.runs.members import Members, Split


@dataclass(frozen=True)
class HeldOut:
    """What the policies think of every row.

    Args:
        surprise: by each seed's policy that did not see the row, ``[S, N]``.
        rating: by the same, ``[S, N]``.
        seen: surprise by the policies that saw it, mean over all, ``[N]``.
        stretch: t of each policy.
    """

    surprise: Tensor
    rating: Tensor
    seen: Tensor
    stretch: list[float]

    def by_episode(self, episodes: Episodes) -> Tensor:
        """Mean over each episode's steps of at most 12 decades each, by each seed, ``[S, E]``."""
        counted = self.surprise.double().clamp(max=MOST_DECADES)
        total = counted.new_zeros(len(counted), len(episodes.starts))
        return total.index_add_(1, episodes.of_rows(), counted) / episodes.lengths


def typical_stretch(distance: Tensor, dims: int) -> float:
    """By what the median of squared distances exceeds a chi-squared one's, at least 1.

    Args:
        distance: ``[N]``.
        dims: A, the degrees of freedom.

    Examples:
        >>> round(typical_stretch(torch.tensor([2.7726]), 2), 3)  # median of 2 degrees: 2 ln 2
        2.0
    """
    low, high = 0.0, float(dims)  # the median is less than the mean
    half = torch.tensor(dims / 2, dtype=torch.float64)
    for _ in range(60):
        middle = (low + high) / 2
        below = float(torch.special.gammainc(half, torch.tensor(middle / 2, dtype=torch.float64))) < 0.5
        low, high = (middle, high) if below else (low, middle)
    return max(1.0, float(distance.double().median()) / high)


def hold_out(members: Members, data: TensorDictBase, splits: Sequence[Split], seeds: int) -> HeldOut:
    """Asks every policy about every row.

    Args:
        members: of which the first are those of the splits.
        data: ``[N]``.
        splits: those of one seed together; each row is held out once a seed.
        seeds: how many.

    Returns:
        Surprises and ratings.
    """
    distance, rating = members.ask(data)
    dims, size = data["action"].shape[1], len(data)
    surprise, rated = torch.empty(seeds, size), torch.empty(seeds, size)
    seen, times, stretch = torch.zeros(size), torch.zeros(size), []
    one = torch.ones(())
    folds = len(splits) // seeds
    for k, split in enumerate(splits):
        held, saw = split.held_out, ~split.held_out
        stretch.append(typical_stretch(distance[k, held], dims))
        surprise[k // folds, held] = surprise_of(distance[k, held] / stretch[-1], dims, one)
        rated[k // folds, held] = rating[k, held]
        seen[saw] += surprise_of(distance[k, saw], dims, one)
        times[saw] += 1
    return HeldOut(surprise, rated, seen / times, stretch)
