"""Figures as PNG files, from plain data; matplotlib is imported when a figure is drawn."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from torchrl_tsallis.evaluation.statistics import _checked, bootstrap_interval
from torchrl_tsallis.jobs import atomic_path

# Okabe and Ito's palette: told apart with every common colour blindness.
PALETTE = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#8C8C8C", "#000000")


def _canvas(width: float, height: float) -> Any:
    """A figure without pyplot's global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Any, path: str | os.PathLike[str]) -> Path:
    """Writes a figure as PNG, atomically."""
    if Path(path).suffix.lower() != ".png":
        raise ValueError(f"cannot write {str(path)!r}: use .png")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")
    return Path(path)


@contextmanager
def _figure(path: str | os.PathLike[str], width: float, height: float = 3.4) -> Iterator[Any]:
    """Yields axes that are saved afterwards."""
    figure = _canvas(width, height)
    axes = figure.subplots()
    axes.spines[["top", "right"]].set_visible(False)
    yield axes
    _save(figure, path)


def _not_empty(data: Mapping[str, Any]) -> None:
    if not data:
        raise ValueError("nothing to draw: the mapping is empty")


def return_by_method(returns: Mapping[str, ArrayLike], path: str | os.PathLike[str], *, title: str = "") -> Path:
    """Box and strip of the returns by method, with the median's 95 % bootstrap interval.

    Args:
        returns: method -> ``[S]`` or ``[S, E]`` returns, drawn in the mapping's order.
        path: PNG to write.
        title: above the axes.

    Returns:
        The path.

    Raises:
        ValueError: if a method has no return or a NaN.

    Examples:
        >>> import tempfile
        >>> return_by_method({"BC": [1.0, 2.0], "q = 0.8": [2.0, 4.0]}, tempfile.mkdtemp() + "/returns.png").name
        'returns.png'
    """
    _not_empty(returns)
    values = {name: _checked(v, f"returns[{name!r}]") for name, v in returns.items()}
    rng = np.random.default_rng(0)
    units = set()
    with _figure(path, max(4.2, 1.1 * len(values) + 1)) as axes:
        for i, array in enumerate(values.values()):
            colour = PALETTE[i % len(PALETTE)]
            flat = array.ravel()
            axes.boxplot(
                [flat],
                positions=[i],
                widths=0.5,
                showfliers=False,
                patch_artist=True,
                boxprops={"facecolor": colour, "alpha": 0.25},
                medianprops={"color": "black", "linewidth": 0},
            )
            axes.scatter(i + rng.uniform(-0.18, 0.18, flat.size), flat, s=7, color=colour, alpha=0.5, linewidths=0)
            result = bootstrap_interval(array, lambda x: float(np.median(x)))
            units.add(result["unit"])
            # Not `yerr`: a percentile interval need not hold the estimate.
            axes.plot([i, i], [result["low"], result["high"]], color="black", linewidth=2, zorder=4)
            axes.plot(i, result["value"], "D", color="black", markerfacecolor="white", markersize=5, zorder=5)
            axes.annotate(
                f"{result['value']:.0f}", (i, result["value"]), (9, -3), textcoords="offset points", fontsize=8
            )
        axes.set_xticks(range(len(values)), list(values))
        axes.set_xlim(-0.6, len(values) - 0.4)
        axes.set_ylabel("return (sum of rewards)")
        over = " or ".join(f"{unit}s" for unit in sorted(units))
        axes.set_xlabel(f"diamond: median, bar: 95 % interval over {over}", fontsize=8)
        axes.set_title(title)
    return Path(path)


def rating_histogram(
    ratings: Mapping[str, ArrayLike], path: str | os.PathLike[str], *, floor: float = 1e-8, title: str = ""
) -> Path:
    """Histogram of the implicit weights rho by kind of sample, log x; smaller values join the floor's bin.

    Args:
        ratings: kind (clean, noisy, amateur) -> rho, any shape, not negative.
        path: PNG to write.
        floor: smallest rating shown (1e-8).
        title: above the axes.

    Returns:
        The path.

    Raises:
        ValueError: if a kind is empty, has NaN or a negative rating.

    Examples:
        >>> import tempfile
        >>> rating_histogram({"clean": [0.5, 1.0], "noisy": [0.0]}, tempfile.mkdtemp() + "/rho.png").name
        'rho.png'
    """
    _not_empty(ratings)
    values = {name: _checked(v, f"ratings[{name!r}]").ravel() for name, v in ratings.items()}
    for name, array in values.items():
        if (array < 0).any() or np.isinf(array).any():
            raise ValueError(f"ratings[{name!r}] must be finite and not negative: pass rho, not its logarithm")
    top = max(max(float(v.max()) for v in values.values()) * 1.05, 10 * floor)
    low = max(floor, min(float(v.min()) for v in values.values()) / 1.05)
    bins = np.geomspace(min(low, top / 10), top, 51)
    with _figure(path, 5.2) as axes:
        for i, (name, array) in enumerate(values.items()):
            axes.hist(
                np.clip(array, bins[0], bins[-1]),
                bins,
                weights=np.full(array.size, 1 / array.size),
                histtype="stepfilled",
                facecolor=(PALETTE[i % len(PALETTE)], 0.3),
                edgecolor=PALETTE[i % len(PALETTE)],
                label=f"{name} (n = {array.size}, median {np.median(array):.2g})",
            )
        axes.set_xscale("log")
        note = f"; values below {floor:g} in the first bin" if low == floor else ""
        axes.set_xlabel(rf"rating $\rho$ (no unit{note})")
        axes.set_ylabel("share of the kind's samples")
        axes.legend(frameon=False, fontsize=8)
        axes.set_title(title)
    return Path(path)


def schedule(
    curves: Mapping[str, Mapping[str, Sequence[float]]], path: str | os.PathLike[str], *, title: str = ""
) -> Path:
    """Index q (solid) and gamma (dashed) over training, one colour a method.

    Args:
        curves: method -> ``{"step": [N], "q": [N], "gamma": [N]}``; q or gamma may be left out.
        path: PNG to write.
        title: above the axes.

    Returns:
        The path.

    Raises:
        ValueError: if a curve lacks ``step`` or its lengths differ.

    Examples:
        >>> import tempfile
        >>> curve = {"step": [0, 1], "q": [0.8, 0.9], "gamma": [0.1, 0.2]}
        >>> schedule({"proposal": curve}, tempfile.mkdtemp() + "/schedule.png").name
        'schedule.png'
    """
    _not_empty(curves)
    with _figure(path, 5.2) as axes:
        for i, (name, curve) in enumerate(curves.items()):
            if "step" not in curve:
                raise ValueError(f"curves[{name!r}] has no 'step', only {sorted(curve)}")
            for key, line in (("q", "-"), ("gamma", "--")):
                if key not in curve:
                    continue
                if len(curve[key]) != len(curve["step"]):
                    raise ValueError(f"curves[{name!r}]: {len(curve[key])} {key}, {len(curve['step'])} steps")
                label = f"{name}: " + ("$q$" if key == "q" else r"$\gamma$")
                axes.plot(curve["step"], curve[key], line, color=PALETTE[i % len(PALETTE)], label=label)
        axes.set_ylim(-0.02, 1.05)
        axes.set_xlabel("training step (batches)")
        axes.set_ylabel(r"$q$, $\gamma$ (no unit)")
        axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
        axes.set_title(title)
    return Path(path)


def auroc_bars(values: Mapping[str, float], path: str | os.PathLike[str], *, title: str = "") -> Path:
    """AUROC of the rating as a detector of bad samples, one bar a method.

    Args:
        values: method -> area under the ROC curve, in [0, 1].
        path: PNG to write.
        title: above the axes.

    Returns:
        The path.

    Raises:
        ValueError: if a value is NaN or outside [0, 1].

    Examples:
        >>> import tempfile
        >>> auroc_bars({"BC": 0.5, "proposal": 0.97}, tempfile.mkdtemp() + "/auroc.png").name
        'auroc.png'
    """
    _not_empty(values)
    for name, value in values.items():
        if not 0 <= value <= 1:
            raise ValueError(f"values[{name!r}] = {value} is not an AUROC in [0, 1]")
    with _figure(path, max(3.5, 0.9 * len(values) + 1.5)) as axes:
        colours = [PALETTE[i % len(PALETTE)] for i in range(len(values))]
        bars = axes.bar(list(values), list(values.values()), color=colours, width=0.6)
        axes.bar_label(bars, fmt="%.3f", fontsize=8, padding=2)
        axes.axhline(0.5, color="black", linewidth=0.8, linestyle=":")
        axes.annotate("chance", (1.01, 0.5), xycoords=("axes fraction", "data"), va="center", fontsize=8)
        axes.set_ylim(0, 1.08)
        axes.set_ylabel("AUROC, clean above bad samples")
        axes.set_title(title)
    return Path(path)
