"""Statistics over seeds: median, interquartile mean with bootstrap intervals, AUROC."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from torchrl_tsallis._checks import check_callable, check_number, check_seed, shown
from torchrl_tsallis.evaluation.settings import whole_number


def _checked(values: ArrayLike, name: str) -> np.ndarray:
    """Returns a float64 array that is not empty and has no NaN."""
    message = f"{name} must be a rectangular array of numbers (as many episodes a seed)"
    try:
        given = np.asarray(values)
        if given.dtype.kind not in "fiub":  # NumPy makes numbers of text and None
            raise ValueError(message)
        array = given.astype(np.float64)
    except Exception as error:  # whatever an object that is no array raises
        raise ValueError(f"{message}, got {shown(values)}") from error
    if array.size == 0:
        raise ValueError(f"{name} is empty: no episode was given")
    if np.isnan(array).any():
        raise ValueError(f"{name} has NaN at index {tuple(map(int, np.argwhere(np.isnan(array))[0]))}")
    return array


def _checked_seed(confidence: float, resamples: int, seed: int) -> int:
    """The seed of a bootstrap, all of whose settings are checked."""
    check_number("confidence", confidence, above=0, below=1)
    whole_number("resamples", resamples, 1)
    return check_seed("seed", seed, low=0)


def median(values: ArrayLike) -> float:
    """Median over all entries.

    Examples:
        >>> median([1.0, 5.0, 3.0])
        3.0
    """
    return float(np.median(_checked(values, "values")))


def iqm(values: ArrayLike) -> float:
    """Interquartile mean: the mean of the middle half, with fractional weights at its ends.

    Agarwal et al., NeurIPS 2021 (arXiv 2108.13264). Unlike a trimmed mean that cuts whole entries, sizes that four
    does not divide keep a share of the entries at the quartiles.

    Args:
        values: any shape; all entries are pooled.

    Returns:
        The mean of the middle half.

    Examples:
        >>> iqm([0.0, 2.0, 4.0, 100.0])
        3.0
    """
    ordered = np.sort(_checked(values, "values"), axis=None)
    edges = np.arange(ordered.size + 1) / ordered.size
    weight = np.clip(edges[1:], 0.25, 0.75) - np.clip(edges[:-1], 0.25, 0.75)
    return float(np.sum(ordered * weight) / 0.5)


def bootstrap_interval(
    scores: ArrayLike,
    statistic: Callable[[np.ndarray], float] = iqm,
    *,
    confidence: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> dict[str, Any]:
    """Statistic with a percentile bootstrap interval, stratified by task, over seeds.

    The seeds are the replication unit: they are drawn with replacement inside each task and keep all their
    episodes. With one seed only, its episodes are drawn instead, and ``unit`` says so: that interval leaves out
    the difference between trainings.

    Args:
        scores: ``[S]`` one score a seed, ``[S, E]`` episodes, or ``[T, S, E]`` tasks (the strata).
        statistic: function of an array (:func:`iqm`).
        confidence: coverage (0.95).
        resamples: bootstrap draws (2000).
        seed: of the generator (0).

    Returns:
        ``{"value", "low", "high", "unit", "n"}``; ``unit`` is ``"seed"`` or ``"episode"``, n their number a task.

    Raises:
        ValueError: if scores are empty, ragged or NaN, or an argument is out of range.

    Examples:
        >>> bootstrap_interval([[1.0, 1.0], [1.0, 1.0]])
        {'value': 1.0, 'low': 1.0, 'high': 1.0, 'unit': 'seed', 'n': 2}
    """
    array = _checked(scores, "scores")
    seed = _checked_seed(confidence, resamples, seed)
    check_callable("statistic", statistic, "makes a number of an array")
    if not 1 <= array.ndim <= 3:
        raise ValueError(f"need scores [S], [S, E] or [T, S, E], got {array.shape}")
    if array.ndim < 3:
        array = array.reshape(1, array.shape[0], -1)
    unit = "seed" if array.shape[1] > 1 else "episode"
    if unit == "episode":
        array = array.reshape(array.shape[0], -1, 1)
    tasks, n, _ = array.shape
    rng = np.random.default_rng(seed)
    rows = np.arange(tasks)[:, None]
    check_number("statistic(scores)", statistic(array), finite=False)
    draws = [statistic(array[rows, rng.integers(n, size=(tasks, n))]) for _ in range(resamples)]
    low, high = np.quantile(draws, [(1 - confidence) / 2, (1 + confidence) / 2])
    return {"value": float(statistic(array)), "low": float(low), "high": float(high), "unit": unit, "n": n}


def auroc(positive: ArrayLike, negative: ArrayLike) -> float:
    """Probability that a positive scores above a negative, a tie counting one half (area under the ROC curve).

    Args:
        positive: scores of the samples that should score high, any shape.
        negative: scores of the others, any shape.

    Returns:
        A number in [0, 1].

    Raises:
        ValueError: if a class is empty or has NaN.

    Examples:
        >>> auroc([3.0, 2.0], [1.0, 2.0])
        0.875
    """
    high = _checked(positive, "positive").ravel()
    low = np.sort(_checked(negative, "negative"), axis=None)
    below = np.searchsorted(low, high, "left") + np.searchsorted(low, high, "right")
    return float(below.sum() / (2 * high.size * low.size))


def probability_of_improvement(x: ArrayLike, y: ArrayLike) -> float:
    """Probability that a random score of ``x`` beats one of ``y``, ties one half (Agarwal et al., 2021).

    Args:
        x: one score a seed, ``[S]``.
        y: one score a seed, ``[S']``.

    Returns:
        A number in [0, 1]; 0.5 is no difference.

    Raises:
        ValueError: if an input is empty, has NaN or is not one-dimensional.

    Examples:
        >>> probability_of_improvement([2.0, 3.0], [1.0, 2.5])
        0.75
    """
    a, b = _checked(x, "x"), _checked(y, "y")
    if a.ndim != 1 or b.ndim != 1:
        raise ValueError(
            f"need one score a seed of x and y, got shapes {a.shape} and {b.shape}: reduce over episodes first"
        )
    return auroc(a, b)


def improvement_interval(
    x: ArrayLike, y: ArrayLike, *, confidence: float = 0.95, resamples: int = 2000, seed: int = 0
) -> dict[str, float]:
    """Probability of improvement with a percentile bootstrap interval over seeds, stratified by task.

    The seeds of both are drawn with replacement inside each task; over several tasks it is the mean of theirs.

    Args:
        x: one score a seed, ``[S]``, or ``[T, S]`` for several tasks.
        y: one score a seed, ``[S']`` or ``[T, S']``.
        confidence: coverage (0.95).
        resamples: bootstrap draws (2000).
        seed: of the generator (0).

    Returns:
        ``{"value", "low", "high"}``.

    Raises:
        ValueError: if an input is empty or has NaN, or the numbers of tasks differ.

    Examples:
        >>> improvement_interval([2.0, 3.0], [1.0, 1.5])
        {'value': 1.0, 'low': 1.0, 'high': 1.0}
    """
    a, b = np.atleast_2d(_checked(x, "x")), np.atleast_2d(_checked(y, "y"))
    seed = _checked_seed(confidence, resamples, seed)
    if a.ndim != 2 or b.ndim != 2 or len(a) != len(b):
        raise ValueError(f"x and y must be [S] or [T, S] of as many tasks, got {a.shape} and {b.shape}")
    wins = (a[:, :, None] > b[:, None]) + 0.5 * (a[:, :, None] == b[:, None])  # [T, S, S']
    rng = np.random.default_rng(seed)
    tasks = np.arange(len(a))[:, None, None]
    draws = []
    for _ in range(resamples):
        i, j = (rng.integers(n, size=(len(a), n)) for n in wins.shape[1:])
        draws.append(wins[tasks, i[:, :, None], j[:, None]].mean())
    low, high = np.quantile(draws, [(1 - confidence) / 2, (1 + confidence) / 2])
    return {"value": float(wins.mean()), "low": float(low), "high": float(high)}
