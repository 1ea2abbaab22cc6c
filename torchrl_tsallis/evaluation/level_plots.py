"""Scores over a level, such as how noisy the demonstrators are: a panel a task, a line a method."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from torchrl_tsallis.evaluation.plots import PALETTE, _canvas, _save
from torchrl_tsallis.evaluation.statistics import _checked, bootstrap_interval, median

#: Markers, so that lines are told apart without colour.
MARKERS = "osD^vPX*"


def returns_by_level(
    panels: Mapping[str, Mapping[str, Mapping[float, ArrayLike]]],
    path: str | os.PathLike[str],
    *,
    level: str,
    title: str = "",
) -> Path:
    """Draws the median return of every method over a level, with 95 % bootstrap intervals and the median of each seed.

    Args:
        panels: task -> method -> level -> ``[S]`` or ``[S, E]`` returns. A level that a method lacks leaves a gap.
        path: PNG to write.
        level: what the level is, with its unit.
        title: above the panels.

    Returns:
        The path.

    Raises:
        ValueError: if there is nothing to draw, or returns are missing or NaN.

    Examples:
        >>> import tempfile
        >>> panels = {"clean": {"BC": {0.1: [1.0, 2.0], 0.2: [2.0, 3.0]}}}
        >>> returns_by_level(panels, tempfile.mkdtemp() + "/map.png", level="noise").name
        'map.png'
    """
    if not panels or not all(panels.values()):
        raise ValueError("nothing to draw: a panel needs at least one method")
    methods = list(dict.fromkeys(method for scores in panels.values() for method in scores))
    levels = sorted({value for scores in panels.values() for of in scores.values() for value in of})
    step = min(np.diff(levels), default=1.0)
    figure = _canvas(4.4 * len(panels) + 1.6, 3.8)
    grid = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, (task, scores) in zip(grid, panels.items(), strict=True):
        for method, of in scores.items():
            place = methods.index(method)
            shift = (place - (len(methods) - 1) / 2) * 0.07 * step  # side by side: intervals would hide each other
            style = {"color": PALETTE[place % len(PALETTE)], "marker": MARKERS[place % len(MARKERS)]}
            xs, values = sorted(of), [_checked(of[x], f"panels[{task!r}][{method!r}][{x:g}]") for x in sorted(of)]
            results = [bootstrap_interval(value, median) for value in values]
            centre = [result["value"] for result in results]
            bars = [[r["value"] - r["low"] for r in results], [r["high"] - r["value"] for r in results]]
            axes.errorbar(np.add(xs, shift), centre, bars, label=method, markersize=4, linewidth=1, **style)
            for x, value in zip(xs, values, strict=True):
                seeds = np.median(value.reshape(len(value), -1), axis=1)
                axes.scatter(np.full(len(seeds), x + shift), seeds, s=5, alpha=0.4, linewidths=0, color=style["color"])
        axes.set_title(task, fontsize=10)
        axes.set_xlabel(level, fontsize=8)
        axes.set_xticks(levels)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", linewidth=0.4, alpha=0.5)
    grid[0].set_ylabel("return (sum of rewards)", fontsize=8)
    legend = {label: handle for axes in grid for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    names = [method for method in methods if method in legend]
    figure.legend([legend[name] for name in names], names, loc="outside right upper", fontsize=8, frameon=False)
    figure.suptitle(title, fontsize=11)
    return _save(figure, path)
