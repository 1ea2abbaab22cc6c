"""A grid of panels, one a task, with the score of every method and its interval: figure 3 of the paper."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from torchrl_tsallis.evaluation.plots import PALETTE, _canvas
from torchrl_tsallis.evaluation.statistics import _checked, bootstrap_interval, iqm, median
from torchrl_tsallis.jobs import atomic_path


def returns_grid(
    panels: Mapping[str, Mapping[str, ArrayLike]], paths: Sequence[str | os.PathLike[str]], *, title: str = ""
) -> list[Path]:
    """Draws median and interquartile mean of every method, with 95 % bootstrap intervals, a panel a task.

    Args:
        panels: task -> method -> ``[S]`` or ``[S, E]`` returns. Methods are on the x axis, in the order of the first
            task; a method that another task lacks leaves a gap there.
        paths: files to write; ``.png`` or ``.svg``.
        title: above the panels.

    Returns:
        The paths.

    Raises:
        ValueError: for other kinds of files, and for returns that are missing or NaN.

    Examples:
        >>> import tempfile
        >>> returns_grid({"clean": {"BC": [1.0, 2.0]}}, [tempfile.mkdtemp() + "/figure3.svg"])[0].name
        'figure3.svg'
    """
    import matplotlib

    targets = [Path(path) for path in paths]
    for path in targets:
        if path.suffix not in (".png", ".svg"):
            raise ValueError(f"cannot write {str(path)!r}: use .png or .svg")
    if not panels or not all(panels.values()):
        raise ValueError("nothing to draw: a panel needs at least one method")
    methods = list(dict.fromkeys(method for scores in panels.values() for method in scores))
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    size = (columns * max(3.0, 0.45 * len(methods) + 1.0), 2.6 * rows + 0.9)
    figure = _canvas(*size)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    for axes, (task, scores) in zip(grid.flat, panels.items(), strict=False):
        for method, values in scores.items():
            _draw(axes, methods.index(method), _checked(values, f"panels[{task!r}][{method!r}]"))
        axes.set_title(task, fontsize=10)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_xticks(range(len(methods)), methods, rotation=45, ha="right", fontsize=8)
        axes.set_xlim(-0.6, len(methods) - 0.4)
        axes.grid(axis="y", linewidth=0.4, alpha=0.5)
    for axes in grid[:, 0]:
        axes.set_ylabel("return (sum of rewards)", fontsize=8)
    marks = "diamond (left): median; square (right): interquartile mean; dots: median of each seed"
    figure.supxlabel(f"{marks}; bars: 95 % bootstrap intervals", fontsize=7)
    figure.suptitle(title, fontsize=11)
    # The salt and the date make equal data equal files.
    with matplotlib.rc_context({"svg.hashsalt": "figure3", "svg.fonttype": "none"}):
        for path in targets:
            with atomic_path(path) as temporary:
                metadata = {"Date": None} if path.suffix == ".svg" else None
                figure.savefig(temporary, format=path.suffix[1:], metadata=metadata)
    return targets


def _draw(axes: Any, x: int, values: np.ndarray) -> None:
    """Median and interquartile mean of one method, and the medians of its seeds."""
    colour = PALETTE[x % len(PALETTE)]
    seeds = np.median(values.reshape(len(values), -1), axis=1)
    axes.scatter(np.full(len(seeds), x), seeds, s=5, color=colour, alpha=0.4, linewidths=0)
    for shift, statistic, marker in ((-0.18, median, "D"), (0.18, iqm, "s")):
        result = bootstrap_interval(values, statistic)
        axes.plot([x + shift] * 2, [result["low"], result["high"]], color=colour, linewidth=2)
        axes.plot(x + shift, result["value"], marker, color=colour, markerfacecolor="white", markersize=4)
