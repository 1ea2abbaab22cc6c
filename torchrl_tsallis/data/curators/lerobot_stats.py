"""LeRobot's statistics of a data set, made anew for the episodes that stay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def of_rows(rows: np.ndarray, wanted: Sequence[str]) -> dict[str, list[Any]]:
    """Statistics of the rows ``[N, *]`` under LeRobot's names; those that are none of its own are left out.

    Examples:
        >>> of_rows(np.array([1, 2, 6]), ["min", "mean", "count", "q50"])
        {'min': [1.0], 'mean': [3.0], 'count': [3], 'q50': [2.0]}
    """
    values = np.asarray(rows, dtype=np.float64).reshape(len(rows), -1)
    known: dict[str, Any] = {
        "min": lambda: values.min(0),
        "max": lambda: values.max(0),
        "mean": lambda: values.mean(0),
        "std": lambda: values.std(0),
    }
    out: dict[str, list[Any]] = {}
    for name in wanted:
        if name == "count":
            out[name] = [len(values)]
        elif name in known:
            out[name] = known[name]().tolist()
        elif name in _QUANTILES:
            out[name] = np.quantile(values, _QUANTILES[name], axis=0).tolist()
    return out


def of_episodes(episodes: Sequence[Mapping[str, Any]], wanted: Sequence[str]) -> dict[str, Any] | None:
    """Joins statistics of episodes, as of images, of which no row is decoded; None where an episode has none.

    Mean and deviation are exact for the frames that LeRobot sampled, quantiles are means weighted by these.

    Examples:
        >>> one, two = ({"count": [n], "mean": [m], "std": [0.0], "min": [m]} for n, m in ((1, 0.0), (3, 4.0)))
        >>> of_episodes([one, two], ["mean", "std", "min", "count"])
        {'mean': [3.0], 'std': [1.7320508075688772], 'min': [0.0], 'count': [4]}
    """
    if not episodes or any(key not in episode for episode in episodes for key in ("count", "mean", "std")):
        return None
    if any(key not in episode for episode in episodes for key in wanted):
        return None
    stacked = {key: np.stack([np.asarray(e[key], np.float64) for e in episodes]) for key in {*wanted, "mean", "std"}}
    counts = np.array([float(np.asarray(episode["count"]).reshape(-1)[0]) for episode in episodes])
    weights = (counts / counts.sum()).reshape(-1, *[1] * (stacked["mean"].ndim - 1))
    mean = (weights * stacked["mean"]).sum(0)
    out: dict[str, Any] = {}
    for key in wanted:
        if key == "count":
            out[key] = [int(counts.sum())]
        elif key == "std":
            out[key] = np.sqrt((weights * (stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2)).sum(0)).tolist()
        elif key in ("min", "max"):
            out[key] = getattr(stacked[key], key)(0).tolist()
        else:
            out[key] = (weights * stacked[key]).sum(0).tolist()
    return out
