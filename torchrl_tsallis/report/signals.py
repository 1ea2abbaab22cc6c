"""Simple signals of an episode beside its surprise: how each is read, and what it can and cannot see."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np


@dataclass(frozen=True)
class Signal:
    """A column of ``episodes.csv`` that is a number an episode.

    Args:
        key: name of the column.
        title: for people.
        unit: of the number.
        extreme: which values call for a look: the ``"high"`` or ``"low"`` ones, or those ``"far"`` from the median.
        sees: what it can see.
        blind: what it cannot.
    """

    key: str
    title: str
    unit: str
    extreme: Literal["high", "low", "far"]
    sees: str
    blind: str


#: In the order of the page.
SIGNALS = (
    Signal(
        "steps",
        "Length",
        "steps",
        "far",
        "episodes that were broken off, or took long; it is often the best signal of all.",
        "how anything was done.",
    ),
    Signal(
        "knn_residual",
        "Unlike its neighbours",
        "robust deviations an action dimension",
        "high",
        "actions that other episodes did not take in similar states, as the surprise does, without a policy.",
        "what is wrong in states that no other episode visits; it takes different good solutions for errors, and needs "
        "few observation dimensions.",
    ),
    Signal(
        "deminf",
        "State tells action (DemInf)",
        "nats",
        "low",
        "noise and hesitation: actions that follow less from the state than those of other episodes.",
        "a mistake that is made every time, which is as predictable as the right action; and it asks for many rows.",
    ),
    Signal(
        "jerk",
        "Jerk of the actions",
        "median third difference, in robust deviations",
        "high",
        "shaking, and recordings whose values jump.",
        "smooth mistakes; quick and right motions have more of it than slow ones.",
    ),
    Signal(
        "path_length",
        "Path of the observation",
        "robust deviations",
        "far",
        "detours, repeated attempts, and unfinished episodes.",
        "how anything was done; other starting places change it without any fault.",
    ),
    Signal(
        "still_share",
        "Still steps",
        "share of the steps",
        "high",
        "waiting, a frozen sensor, a recording that went on after the end.",
        "hesitation in motion; waiting that belongs to the task counts as a fault.",
    ),
)

#: Shown where there are rewards: no fault is looked for in it, the surprise is compared with it.
RETURN = Signal(
    "return",
    "Return",
    "sum of the rewards",
    "low",
    "how well the episode did by the rewards in the file, which are not used for the surprise.",
    "nothing of how; where it rises with the surprise, the surprising episodes are the better ones.",
)


def most_extreme(values: np.ndarray, extreme: str, count: int = 3) -> list[int]:
    """Episodes to look at first by a signal.

    Args:
        values: ``[E]``, NaN where missing.
        extreme: see :class:`Signal`.
        count: how many at most.

    Returns:
        Their places, the most extreme first; none if all values are equal.

    Examples:
        >>> most_extreme(np.array([5.0, np.nan, 1.0, 6.0]), "far", 2), most_extreme(np.array([2.0, 2.0]), "high")
        ([2, 3], [])
    """
    there = np.flatnonzero(~np.isnan(values))
    if len(there) == 0 or (values[there] == values[there[0]]).all():
        return []
    found = values[there]
    score = {"high": found, "low": -found, "far": np.abs(found - np.median(found))}[extreme]
    return there[np.argsort(-score, kind="stable")][:count].tolist()
