"""Which component an episode belongs to, and how that is annealed."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchrl_tsallis._checks import check_number


def responsibilities(log_likelihood: Tensor, share: Tensor, temperature: float) -> Tensor:
    r"""Responsibilities of components for episodes.

    .. math:: r_{ec} = \mathrm{softmax}_c \left( T \bar\ell_{ec} + \tfrac{1}{10} \ln \pi_c \right)

    Args:
        log_likelihood: mean over the steps of each episode, ``[C, E]``.
        share: of the episodes that each component has, ``[C]``.
        temperature: T; a small one leaves all components nearly equal.

    Returns:
        ``[C, E]``; the sum over components is 1.

    Examples:
        >>> given = torch.tensor([[0.0, 1.0], [0.0, 0.0]])
        >>> responsibilities(given, torch.tensor([0.5, 0.5]), 2.0).round(decimals=3)
        tensor([[0.5000, 0.8810],
                [0.5000, 0.1190]])
    """
    return (temperature * log_likelihood + share.clamp_min(1e-12).log()[:, None] / 10).softmax(0)


@dataclass(frozen=True)
class Annealing:
    """When responsibilities are computed, and how sharp they are.

    Args:
        start: updates that are left out while the components begin to differ.
        length: updates after which the last temperature is reached.
        first: temperature of the first update.
        last: temperature of the last one, in nats a step.

    Raises:
        ValueError: if a number is negative, or not finite.

    Examples:
        >>> plan = Annealing(start=5, length=40)
        >>> plan.temperature(5), plan.temperature(45), plan.temperature(4)
        (0.5, 20.0, 0.0)
    """

    start: int = 5
    length: int = 40
    first: float = 0.5
    last: float = 20.0

    def __post_init__(self) -> None:
        """Checks the numbers."""
        check_number("start", self.start, low=0, integer=True)
        check_number("length", self.length, low=1, integer=True)
        check_number("first", self.first, above=0)
        check_number("last", self.last, above=0)

    def temperature(self, update: int) -> float:
        """Temperature of an update, geometric between first and last; 0 before the start."""
        if update < self.start:
            return 0.0
        share = min(1.0, (update - self.start) / self.length)
        return self.first * (self.last / self.first) ** share


def random_responsibilities(components: int, episodes: int, generator: torch.Generator) -> Tensor:
    """A soft start: uniform numbers, normalised over the components, ``[C, E]``.

    Examples:
        >>> random_responsibilities(3, 5, torch.Generator().manual_seed(0)).sum(0).allclose(torch.ones(5).double())
        True
    """
    start = torch.rand(components, episodes, generator=generator, dtype=torch.float64)
    return start / start.sum(0)
