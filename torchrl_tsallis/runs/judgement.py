"""What may be said of surprises: intervals over seeds, agreement, calibration, and whether they are usable at all.

============================  =========  =================================================================
limit                         value      the ratings are not usable if
============================  =========  =================================================================
:data:`LEAST_EPISODES`        8          there are fewer episodes
:data:`LEAST_AGREEMENT`       0.5        the seeds agree less, both on the order of the episodes (mean
                                         Spearman's rho) and on their surprises (:func:`reliability`)
:data:`MOST_STRETCH`          9          squared distances on held-out episodes are more times a normal's
:data:`CALIBRATED`            0.02-0.45  the share of held-out samples with 1 decade or more is outside
:data:`STANDS_OUT`            3 decades  no sample in a thousand of the held-out ones reaches it, and
:data:`NEAR_ONE`              0.9        ... all but one in a thousand of their ratings are above
============================  =========  =================================================================

All of them are conventions: half of a perfect agreement, errors three times as large as expected (9 in squares), and a
wide range about the 10 % that a calibrated surprise has. They ask whether the ratings repeat and fit, not whether they
are right, and were validated on no real data with known faults. On 16 simulated sets of data
(benchmarks/verdict_limits.py) they refuse the two whose actions do not depend on the state, and name no episode in the
two clean ones; of the twelve with corrupted episodes, all of which have these first, they refuse two for their stretch
(seven with a limit of 4).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

LEAST_EPISODES = 8
LEAST_AGREEMENT = 0.5
MOST_STRETCH = 9.0
CALIBRATED = (0.02, 0.45)
STANDS_OUT, NEAR_ONE = 3.0, 0.9
#: Surprises count up to this many decades in an episode's mean, so that one step cannot be all of it.
MOST_DECADES = 12.0
#: Half width of a 95 % interval of Student's t in standard errors, by degrees of freedom.
_STUDENT = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228)


def ranks(values: np.ndarray) -> np.ndarray:
    """Ranks from 0 on; equal values share their mean rank.

    Examples:
        >>> ranks(np.array([3.0, 1.0, 3.0])).tolist()
        [1.5, 0.0, 1.5]
    """
    _, inverse, count = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(count) - (count + 1) / 2)[inverse.reshape(-1)]


def spearman(x: np.ndarray, y: np.ndarray, *, constant: float = 0.0) -> float:
    """Spearman's rank correlation of the pairs that are both there.

    Args:
        x: ``[E]``, NaN where missing.
        y: ``[E]``.
        constant: what it is where one side is constant.

    Returns:
        The correlation; NaN where values are missing and less than three pairs are left.

    Examples:
        >>> spearman(np.array([1.0, 2.0, 9.0, np.nan]), np.array([3.0, 2.0, 1.0, 0.0]))
        -1.0
    """
    there = ~(np.isnan(x) | np.isnan(y))
    if not there.all() and there.sum() < 3:
        return float("nan")
    a, b = (ranks(np.asarray(v)[there]) - (there.sum() - 1) / 2 for v in (x, y))
    size = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return round(float((a * b).sum()) / size, 12) if size else constant


def agreement(surprise: np.ndarray, *, resamples: int = 1000, seed: int = 0) -> dict[str, float | None]:
    """How far seeds put the episodes in the same order.

    Args:
        surprise: of each episode by each seed, ``[S, E]``.
        resamples: bootstrap draws of episodes.
        seed: of the draws.

    Returns:
        Mean of Spearman's rho over pairs of seeds, with a 95 % bootstrap interval over episodes; None for one seed.
    """
    count, episodes = surprise.shape
    if count < 2 or episodes < 2:
        return {"spearman": None, "low": None, "high": None}

    def mean(values: np.ndarray) -> float:
        return float(np.mean([spearman(values[a], values[b]) for a in range(count) for b in range(a)]))

    rng = np.random.default_rng(seed)
    draws = [mean(surprise[:, rng.integers(episodes, size=episodes)]) for _ in range(resamples)]
    low, high = np.quantile(draws, [0.025, 0.975])
    return {"spearman": mean(surprise), "low": float(low), "high": float(high)}


def reliability(surprise: np.ndarray) -> float | None:
    """Share of the surprises' variance that episodes make up and not seeds: the intraclass correlation ICC(1).

    Beside the agreement on the order, since good episodes that are all alike have none, however clear the others are.

    Args:
        surprise: of each episode by each seed, ``[S, E]``.

    Returns:
        At most 1; 0 or less where episodes differ no more than seeds do; None for one seed.

    Examples:
        >>> round(reliability(np.array([[0.0, 1.0, 9.0], [1.0, 0.0, 9.0]])), 2)  # between 48.17, within 1/3
        0.99
    """
    count, episodes = surprise.shape
    if count < 2 or episodes < 2:
        return None
    mean = surprise.mean(0)
    between = count * float(mean.var(ddof=1))
    within = float(((surprise - mean) ** 2).sum()) / (episodes * (count - 1))
    total = between + (count - 1) * within
    return (between - within) / total if total else 0.0


def interval(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """95 % interval of the mean by Student's t, over the first axis; the end below 0 is 0, and NaN for one value.

    Args:
        values: one a seed, ``[S, E]``, not negative. Folds differ between seeds, and so are in the interval.

    Returns:
        Lower and upper end, ``[E]``.

    Examples:
        >>> low, high = interval(np.array([[1.0], [3.0]]))  # 2 +- 12.706 * 1
        >>> low.tolist(), high.round(3).tolist()
        ([0.0], [14.706])
    """
    count = len(values)
    mean = values.mean(0)
    if count < 2:
        return np.full_like(mean, np.nan), np.full_like(mean, np.nan)
    freedom = count - 1
    times = _STUDENT[freedom - 1] if freedom <= len(_STUDENT) else 1.96 + 2.37 / freedom + 2.8 / freedom**2
    half = times * values.std(0, ddof=1) / np.sqrt(count)
    return np.maximum(mean - half, 0.0), mean + half


def judge(
    names: Sequence[str],
    by_seed: np.ndarray,
    surprise: np.ndarray,
    rating: np.ndarray,
    stretch: Sequence[float],
    *,
    seed: int = 0,
) -> dict[str, Any]:
    """Whether the ratings are usable, why not, and a verdict in one sentence.

    Args:
        names: of the episodes.
        by_seed: mean held-out surprise of each episode by each seed, ``[S, E]``.
        surprise: held-out surprise of each sample by each seed, ``[S, N]``.
        rating: held-out rating, ``[S, N]``.
        stretch: typical squared distance on held-out episodes over a normal's, one a policy.
        seed: of the bootstrap.

    Returns:
        ``usable``, ``reasons``, ``agreement``, ``calibration`` and ``sentence``, which ``json`` can write.
    """
    agree = agreement(by_seed, seed=seed) | {"reliability": reliability(by_seed)}
    calibration = {str(k): float((surprise >= k).mean()) for k in (1, 2, 3)}
    times = float(np.median(stretch))
    reasons = []
    if len(names) < LEAST_EPISODES:
        reasons.append(f"{len(names)} episodes are too few: at least {LEAST_EPISODES} are needed")
    rho, share = agree["spearman"], agree["reliability"]
    if rho is None or share is None:
        reasons.append("one seed cannot be compared with another: train at least 2")
    elif max(rho, share) < LEAST_AGREEMENT:
        reasons.append(
            f"the seeds agree neither on the order of the episodes (Spearman {rho:.2f}) nor on their surprises "
            f"(reliability {share:.2f}): one of the two must be {LEAST_AGREEMENT} at least"
        )
    if times > MOST_STRETCH:
        reasons.append(
            f"the policies do not carry over to episodes that they did not see: squared errors are {times:.1f} times "
            f"what the policies expect (at most {MOST_STRETCH:g}); record more episodes, or train fewer steps"
        )
    low, high = CALIBRATED
    if not low <= calibration["1"] <= high:
        reasons.append(
            f"the surprise is not calibrated on held-out episodes: {100 * calibration['1']:.0f} % of the samples have "
            f"1 decade or more, where 10 % are expected (allowed {100 * low:.0f} to {100 * high:.0f} %)"
        )
    if calibration["3"] < 1e-3 and float(np.quantile(rating, 1e-3)) > NEAR_ONE:
        reasons.append("all ratings are near 1: nothing is told apart, and nothing stands out")
    return {
        "usable": not reasons,
        "reasons": reasons,
        "agreement": agree,
        "calibration": calibration,
        "stretch": [float(x) for x in stretch],
        "sentence": "No verdict: " + "; ".join(reasons) + "." if reasons else verdict(names, by_seed),
    }


def stand_out(mean: np.ndarray, low: np.ndarray) -> np.ndarray:
    """Episodes whose interval lies above the median by three robust deviations, ``[E]`` bool.

    Args:
        mean: surprise, ``[E]``.
        low: lower end of its interval, ``[E]``; NaN where there is none.

    Examples:
        >>> stand_out(np.array([1.0, 1.1, 0.9, 9.0]), np.array([0.5, 0.6, np.nan, 8.0])).tolist()
        [False, False, False, True]
    """
    if np.isnan(mean).all():
        return np.zeros(len(mean), dtype=bool)
    median = np.nanmedian(mean)
    return low > median + 3 * 1.4826 * np.nanmedian(np.abs(mean - median))


def verdict(names: Sequence[str], by_seed: np.ndarray) -> str:
    """One sentence about the episodes that stand out: their whole interval lies above the usual ones.

    The usual ones are those up to the median and three times the (normalised) median deviation from it.

    Args:
        names: of the episodes.
        by_seed: mean held-out surprise of each by each seed, ``[S, E]``.

    Examples:
        >>> verdict(["a", "b", "c", "d"], np.array([[1.0, 1.1, 0.9, 9.0], [1.0, 0.9, 1.1, 9.0]]))
        'Look first at d: 1 of 4 episodes is more surprising than the others (9.00 decades a step, the median is 1.00).'
    """
    mean = by_seed.mean(0)
    low, _ = interval(by_seed)
    median, marked = float(np.median(mean)), stand_out(mean, low)
    order = np.argsort(-mean, kind="stable")
    out = [int(e) for e in order if marked[e]]
    most = f"{mean[order[0]]:.2f} decades a step, the median is {median:.2f}"
    if not out:
        return (
            f"No episode stands out from chance between seeds; the most surprising one is {names[order[0]]} ({most})."
        )
    listed = ", ".join(names[e] for e in out[:5]) + (", ..." if len(out) > 5 else "")
    of = f"{len(out)} of {len(names)} episodes {'is' if len(out) == 1 else 'are'}"
    return f"Look first at {listed}: {of} more surprising than the others ({most})."
