"""Counting flipped pages from the history of their angles."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from torchrl_tsallis._checks import check_number, shown

TURNED = math.radians(135.0)  # rad, of the free edge about the ring
STAY = 0.5  # s, for which a page must stay turned
WINDOW = 0.6  # s, pages that turn over this close together are one event


@dataclass(frozen=True)
class FlipCount:
    """What was flipped, in the order of time.

    Args:
        pages: index of the page, ``[F]``.
        steps: step at which each page turned over, ``[F]``.
        events: event each page belongs to, ``[F]``.
        sizes: pages of each event, ``[E]``.
    """

    pages: np.ndarray
    steps: np.ndarray
    events: np.ndarray
    sizes: np.ndarray

    @property
    def total(self) -> int:
        """Flipped pages; a double counts as two."""
        return len(self.pages)

    @property
    def singles(self) -> int:
        """Events of one page."""
        return int((self.sizes == 1).sum())

    @property
    def multiples(self) -> int:
        """Events of two pages or more."""
        return int((self.sizes > 1).sum())


def count_flips(
    angles: np.ndarray, *, dt: float = 0.02, turned: float = TURNED, stay: float = STAY, window: float = WINDOW
) -> FlipCount:
    """Counts the pages that turn over and stay.

    A page is flipped when its free edge passes ``turned`` and remains beyond it for ``stay`` seconds, or to the end of
    the history. Pages that turn over within ``window`` seconds after an event's first one belong to that event.

    Args:
        angles: of the free edges about the ring, ``[T, pages]`` in rad, 0 on the right.
        dt: time between two steps, s.
        turned: angle of a flipped page, rad (135 degrees).
        stay: s.
        window: s.

    Returns:
        The count.

    Raises:
        ValueError: if the history is not finite or no matrix.

    Examples:
        >>> angles = np.zeros((100, 3))
        >>> angles[20:, 2] = angles[25:, 1] = 3.0  # two at once
        >>> angles[60:, 0] = 3.0
        >>> flips = count_flips(angles)
        >>> flips.total, flips.singles, flips.multiples, flips.pages.tolist()
        (3, 1, 1, [2, 1, 0])
    """
    dt, turned = check_number("dt", dt, above=0), check_number("turned", turned)
    stay, window = check_number("stay", stay, low=0), check_number("window", window, low=0)
    try:
        history = np.asarray(angles, dtype=np.float64)
    except Exception as error:  # whatever an object that is no array raises
        raise TypeError(f"angles must be a history [T, pages] of numbers, got {shown(angles)}") from error
    if history.ndim != 2 or not np.isfinite(history).all():
        raise ValueError(f"angles must be a finite history [T, pages] in rad, not {list(history.shape)}")
    angles = np.asarray(angles)
    over = angles > turned
    steps, pages = np.nonzero(over[1:] & ~over[:-1])  # in the order of time
    steps = steps + 1
    hold = round(min(stay / dt, len(angles)))
    stays = np.array([over[t : t + hold + 1, i].all() for t, i in zip(steps, pages, strict=True)], dtype=bool)
    steps, pages = steps[stays], pages[stays]
    events, first = np.zeros(len(steps), dtype=np.int64), 0
    for k in range(1, len(steps)):
        same = (steps[k] - steps[first]) * dt <= window + 1e-9
        events[k] = events[k - 1] + (not same)
        first = first if same else k
    return FlipCount(pages, steps, events, np.bincount(events) if len(events) else events)
