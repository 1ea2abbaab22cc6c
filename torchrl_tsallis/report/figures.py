"""What the pictures of a report show; matplotlib is imported when one is drawn.

Texts in them are the program's own: names of episodes come from files, and stand in the page beside the picture.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from torchrl_tsallis.report.svg import BLUE, INK, LINE, MUTED, ORANGE, STYLE, spread

#: Decades up to which pictures go; what is above is drawn there.
MOST = 12.0
#: Surprise from which a step is marked.
MARKED = 3.0
_HEAT = (0.88, 0.42, 0.10)  # orange on light and dark paper alike; the alpha channel is the value
_PARTS = 40  # of an episode in the strip


def new_figure(width: float, height: float, columns: int = 1, rows: int = 1) -> tuple[Any, list[Any]]:
    """A figure in inches and its axes, in rows."""
    import matplotlib

    with matplotlib.rc_context(STYLE):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(width, height), dpi=150, layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(rows, columns, squeeze=False).reshape(-1).tolist()
    return figure, axes


def draw_strip(axes: Any, surprise: np.ndarray, lengths: np.ndarray) -> None:
    """All episodes in the order of the data, each a column from its first step (below) to its last (above).

    Args:
        axes: to draw on.
        surprise: of the steps, ``[N]``.
        lengths: of the episodes, ``[E]``.
    """
    parts = np.split(surprise, np.cumsum(lengths)[:-1])
    columns = np.stack([spread(part, _PARTS) for part in parts], axis=1)
    image = np.empty((*columns.shape, 4))
    image[..., :3] = _HEAT
    image[..., 3] = np.clip(columns / (2 * MARKED), 0, 1)
    extent = (-0.5, len(lengths) - 0.5, 0, 100)
    axes.imshow(image, aspect="auto", origin="lower", extent=extent, interpolation="none")
    axes.set(xlabel="episode, in the order of the data", ylabel="part of the episode (%)", yticks=(0, 50, 100))
    axes.xaxis.get_major_locator().set_params(integer=True)


def draw_agreement(axes: Any, mean: np.ndarray, low: np.ndarray, high: np.ndarray, marked: np.ndarray) -> None:
    """Episodes by their surprise, with intervals over seeds.

    Args:
        axes: to draw on.
        mean: ``[E]``, sorted, the greatest first.
        low: lower ends, ``[E]``; NaN where there is none.
        high: upper ends, ``[E]``.
        marked: whether an episode stands out, ``[E]``.
    """
    place = np.arange(1, len(mean) + 1)
    for chosen, colour in ((~marked, BLUE), (marked, ORANGE)):
        axes.vlines(place[chosen], low[chosen], np.minimum(high[chosen], MOST), color=colour, alpha=0.45, linewidth=1.5)
        axes.plot(place[chosen], mean[chosen], "o", color=colour, markersize=3)
    axes.axhline(np.nanmedian(mean), color=MUTED, linewidth=1, linestyle=":")
    axes.set(xlabel="rank", ylabel="decades a step", ylim=(0, None))
    axes.xaxis.get_major_locator().set_params(integer=True)


def draw_histogram(axes: Any, surprise: np.ndarray, seen: np.ndarray) -> None:
    """Steps by surprise, for policies that did not see the episode and for those that did.

    Args:
        axes: to draw on.
        surprise: ``[N]``.
        seen: ``[N]``.
    """
    edges = np.linspace(0, MOST, 25)
    there = surprise[~np.isnan(surprise)]
    count, _ = np.histogram(np.clip(there, 0, MOST), edges)
    axes.bar(edges[:-1], count, width=0.5, align="edge", color=BLUE, alpha=0.55, label="not seen")
    count, _ = np.histogram(np.clip(seen[~np.isnan(seen)], 0, MOST), edges)
    axes.stairs(count, edges, color=INK, linewidth=1, label="seen")
    expected = len(there) * (10 ** -edges[:-1] - 10 ** -edges[1:])
    axes.plot(edges[:-1] + 0.25, expected, color=ORANGE, linestyle="--", linewidth=1.2, label="expected")
    axes.set(yscale="log", ylim=(0.7, max(10.0, 2.0 * len(surprise))), xlim=(0, MOST))
    axes.set(xlabel="surprise of a step (decades)", ylabel="steps")
    axes.legend(frameon=False, fontsize=8)


def draw_calibration(axes: Any, shares: Mapping[int, float]) -> None:
    """Share of the held-out steps with so many decades or more, beside the expected one.

    Args:
        axes: to draw on.
        shares: decades -> share.
    """
    decades = np.array(sorted(shares))
    found = np.array([shares[k] for k in decades.tolist()])
    axes.plot(decades, 100 * 10.0**-decades, "--", color=ORANGE, linewidth=1.2, label="expected")
    axes.plot(decades, 100 * np.maximum(found, 1e-5), "o-", color=BLUE, linewidth=1.2, markersize=5, label="found")
    axes.set(yscale="log", ylim=(5e-3, 120), xticks=decades, xlabel="decades or more", ylabel="steps (%)")
    axes.set_yticks([0.01, 0.1, 1, 10, 100], labels=["0.01", "0.1", "1", "10", "100"])
    axes.minorticks_off()
    axes.legend(frameon=False, fontsize=8)


def draw_course(axes: Any, surprise: np.ndarray, seen: np.ndarray) -> None:
    """An episode step by step.

    Args:
        axes: to draw on.
        surprise: by the policies that did not see it, ``[T]``.
        seen: by those that did, ``[T]``.
    """
    step = np.arange(len(surprise))
    if len(step) > 400:  # a screen shows no more
        chosen = np.array_split(step, 400)
        pick = np.array([part[np.nanargmax(np.nan_to_num(surprise[part]))] for part in chosen])
        step, surprise, seen = pick, surprise[pick], seen[pick]
    axes.axhline(MARKED, color=LINE, linewidth=1)
    axes.plot(step, np.minimum(seen, MOST), color=MUTED, linewidth=0.9)
    axes.plot(step, np.minimum(surprise, MOST), color=BLUE, linewidth=1.2, marker="o" if len(step) == 1 else None)
    axes.set(xlabel="step", ylabel="decades", ylim=(0, MOST * 1.03), yticks=(0, 3, 6, 9, 12))
    axes.set_xlim(-0.5, max(step[-1], 1))
    axes.xaxis.get_major_locator().set_params(integer=True)


def draw_signal(axes: Any, values: np.ndarray, surprise: np.ndarray, marked: np.ndarray, unit: str) -> None:
    """A signal of the episodes beside their surprise.

    Args:
        axes: to draw on.
        values: ``[E]``.
        surprise: ``[E]``.
        marked: whether an episode stands out, ``[E]``.
        unit: of the signal.
    """
    for chosen, colour, alpha in ((~marked, BLUE, 0.7), (marked, ORANGE, 1.0)):
        axes.plot(values[chosen], surprise[chosen], "o", color=colour, markersize=3.5, alpha=alpha)
    axes.set(xlabel=unit, ylabel="decades a step", ylim=(0, None))
