"""Where episodes begin and end once single steps are gone."""

from __future__ import annotations

import numpy as np


def bounds(lengths: np.ndarray, keep_rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The first and the last row of each episode that stay.

    Args:
        lengths: steps of each episode, ``[E]``.
        keep_rows: whether a step stays, ``[N]``.

    Returns:
        Two masks ``[N]``; an episode of which no step stays has neither.

    Examples:
        >>> first, last = bounds(np.array([3, 2]), np.array([False, True, True, True, False]))
        >>> first.tolist(), last.tolist()
        ([False, True, False, True, False], [False, False, True, True, False])
    """
    rows = np.flatnonzero(keep_rows)
    episode = np.repeat(np.arange(len(lengths)), lengths)[rows]
    change = np.flatnonzero(np.diff(episode))
    first, last = (np.zeros(len(keep_rows), dtype=bool) for _ in range(2))
    if len(rows):
        first[rows[[0, *(change + 1)]]] = True
        last[rows[[*change, -1]]] = True
    return first, last
