"""Figures of page flipping."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from torchrl_tsallis.evaluation.plots import PALETTE, _canvas, _not_empty, _save
from torchrl_tsallis.evaluation.statistics import _checked, bootstrap_interval


def _draw_bands(axes: Any, time: np.ndarray, bands: Mapping[str, np.ndarray]) -> None:
    """Shades the times at which each mask ``[T]`` is set."""
    for i, (name, band) in enumerate(bands.items()):
        if band.any():
            axes.fill_between(
                time,
                band,
                transform=axes.get_xaxis_transform(),
                step="post",
                color=PALETTE[3 + i % 3],
                alpha=0.2,
                linewidth=0,
                label=name.replace("_", " "),
            )


def force_over_time(
    forces: ArrayLike,
    path: str | os.PathLike[str],
    *,
    angles: ArrayLike,
    flips: Sequence[int] = (),
    faults: Mapping[str, ArrayLike] | None = None,
    dt: float = 0.02,
    limit: float = 3.3,
    title: str = "",
) -> Path:
    """Exerted force of one trajectory above the angles of its pages' free edges.

    Args:
        forces: ``[T, 3]`` in N.
        path: PNG to write.
        angles: of the free edges about the ring, ``[T, pages]`` in rad.
        flips: steps at which pages turned over, drawn as lines.
        faults: name -> ``[T]`` bool, drawn as bands.
        dt: time of a step, s.
        limit: largest force of the arm, N, drawn where the axis reaches it.
        title: above the axes.

    Returns:
        The path.

    Raises:
        ValueError: if the lengths differ or a value is not finite.

    Examples:
        >>> import tempfile
        >>> force_over_time(np.ones((5, 3)), tempfile.mkdtemp() + "/force.png", angles=np.zeros((5, 10))).name
        'force.png'
    """
    force, angle = np.asarray(forces, dtype=float), np.asarray(angles, dtype=float)
    if force.ndim != 2 or force.shape[1] != 3 or angle.ndim != 2 or len(force) != len(angle) or not len(force):
        raise ValueError(f"needed are forces [T, 3] and angles [T, pages], not {force.shape} and {angle.shape}")
    if not (np.isfinite(force).all() and np.isfinite(angle).all()):
        raise ValueError("forces and angles must be finite")
    bands = {name: np.asarray(value, dtype=bool) for name, value in (faults or {}).items()}
    for name, band in bands.items():
        if band.shape != (len(force),):
            raise ValueError(f"faults[{name!r}] has shape {band.shape}, needed is ({len(force)},)")

    figure = _canvas(7.2, 4.6)
    upper, lower = figure.subplots(2, sharex=True)
    time = dt * np.arange(len(force))
    for i, axis in enumerate("xyz"):
        upper.plot(time, force[:, i], color=PALETTE[i], linewidth=0.9, label=f"$F_{axis}$")
    norm = np.linalg.norm(force, axis=1)
    upper.plot(time, norm, color="black", linewidth=1.3, label=r"$\Vert F \Vert$")
    if norm.max() > 0.8 * limit:
        upper.axhline(limit, color="black", linewidth=0.8, linestyle=":")
    lower.plot(time, np.degrees(angle), color=PALETTE[6], linewidth=0.9)
    for axes in (upper, lower):
        axes.spines[["top", "right"]].set_visible(False)
        for step in flips:
            axes.axvline(dt * step, color="black", linewidth=0.8, linestyle="--")
        _draw_bands(axes, time, bands)
    upper.set_ylabel("exerted force [N]")
    upper.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    lower.set_ylabel("angle of pages [deg]")
    lower.set_xlabel("time [s]; dashed: a page turned over")
    upper.set_title(title)
    return _save(figure, path)


def error_curves(
    errors: Mapping[str, tuple[ArrayLike, ArrayLike]], path: str | os.PathLike[str], *, title: str = ""
) -> Path:
    """Error on validation data over training (Fig. 5): the seeds' median with its 95 % bootstrap interval.

    Args:
        errors: method -> epochs ``[E]`` and errors ``[S, E]`` in N^2, positive.
        path: PNG to write.
        title: above the axes.

    Returns:
        The path.

    Raises:
        ValueError: if nothing is given, the shapes differ or a value is NaN.

    Examples:
        >>> import tempfile
        >>> error_curves({"BC": ([1, 2], [[0.3, 0.2], [0.4, 0.1]])}, tempfile.mkdtemp() + "/mse.png").name
        'mse.png'
    """
    _not_empty(errors)
    figure = _canvas(6.0, 3.6)
    axes = figure.subplots()
    seeds = 0
    for colour, (name, (epochs, values)) in zip(PALETTE, errors.items(), strict=False):
        x, y = np.asarray(epochs), _checked(values, f"errors[{name!r}]")
        if y.ndim != 2 or y.shape[1] != len(x):
            raise ValueError(f"errors[{name!r}] has shape {y.shape} for {len(x)} epochs, needed is [seeds, epochs]")
        axes.plot(x, np.median(y, 0), color=colour, linewidth=1.5, label=name)
        seeds = max(seeds, len(y))
        if len(y) > 1:
            bounds = [bootstrap_interval(column, lambda v: float(np.median(v)), resamples=500) for column in y.T]
            low, high = ([bound[end] for bound in bounds] for end in ("low", "high"))
            axes.fill_between(x, low, high, color=colour, alpha=0.2, linewidth=0)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_yscale("log")
    axes.set_xlabel(f"epoch; line: median, band: 95 % interval over {seeds} seeds" if seeds > 1 else "epoch (one seed)")
    axes.set_ylabel("squared error of the action [N$^2$]")
    axes.legend(frameon=False)
    axes.set_title(title)
    return _save(figure, path)


def flip_trajectories(
    trials: Mapping[str, tuple[ArrayLike, ArrayLike]],
    path: str | os.PathLike[str],
    *,
    every: int = 6,
    newton_per_metre: float = 60.0,
    title: str = "",
) -> Path:
    """Paths of the tip in the plane across the ring, with the exerted forces as arrows (Fig. 6).

    Args:
        trials: method -> positions ``[T, 3]`` in m and forces ``[T, 3]`` in N.
        path: PNG to write.
        every: steps between two arrows.
        newton_per_metre: force that an arrow of 1 m would stand for.
        title: above the axes.

    Returns:
        The path.

    Raises:
        ValueError: if nothing is given, the shapes differ or a value is not finite.

    Examples:
        >>> import tempfile
        >>> trial = (np.zeros((5, 3)), np.ones((5, 3)))
        >>> flip_trajectories({"BC": trial}, tempfile.mkdtemp() + "/paths.png").name
        'paths.png'
    """
    _not_empty(trials)
    figure = _canvas(3.0 * len(trials) + 0.6, 3.2)
    all_axes = figure.subplots(1, len(trials), sharex=True, sharey=True, squeeze=False)[0]
    for axes, colour, (name, trial) in zip(all_axes, PALETTE, trials.items(), strict=False):
        x, force = (np.asarray(part, dtype=float) for part in trial)
        if x.shape != force.shape or x.ndim != 2 or x.shape[1] != 3 or not np.isfinite([x, force]).all():
            raise ValueError(f"trials[{name!r}]: needed are finite [T, 3] and [T, 3], not {x.shape} and {force.shape}")
        x, force = 1e3 * x, force / newton_per_metre * 1e3  # mm
        axes.plot([0, 108, 108], [0, 0, -6], color="black", linewidth=1)  # the block of sheets that stay
        axes.plot(x[:, 0], x[:, 2], color=colour, linewidth=0.8)
        arrows = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "width": 0.004, "color": PALETTE[3], "alpha": 0.7}
        axes.quiver(x[::every, 0], x[::every, 2], force[::every, 0], force[::every, 2], **arrows)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_aspect("equal")
        axes.set_xlabel("x [mm], ring at 0")
        axes.set_title(name, fontsize=10)
    all_axes[0].set_ylabel(f"z [mm]; 10 mm of arrow: {newton_per_metre / 100:.1f} N")
    figure.suptitle(title)
    return _save(figure, path)


def ratings_over_time(
    ratings: Mapping[str, ArrayLike],
    path: str | os.PathLike[str],
    *,
    faults: Mapping[str, ArrayLike] | None = None,
    dt: float = 0.02,
    title: str = "",
) -> Path:
    """Rating of each step of one demonstration, above the labelled faults.

    Args:
        ratings: method -> rating, ``[T]``.
        path: PNG to write.
        faults: name -> ``[T]`` bool, drawn as bands.
        dt: time of a step, s.
        title: above the axes.

    Returns:
        The path.

    Raises:
        ValueError: if nothing is given, lengths differ or a rating is NaN.

    Examples:
        >>> import tempfile
        >>> ratings_over_time({"proposal": np.ones(5)}, tempfile.mkdtemp() + "/ratings.png").name
        'ratings.png'
    """
    _not_empty(ratings)
    curves = {name: _checked(value, f"ratings[{name!r}]") for name, value in ratings.items()}
    bands = {name: np.asarray(value, dtype=bool) for name, value in (faults or {}).items()}
    length = len(next(iter(curves.values())))
    for name, value in [*curves.items(), *bands.items()]:
        if value.shape != (length,):
            raise ValueError(f"{name!r} has shape {value.shape}, needed is ({length},)")
    figure = _canvas(7.2, 3.2)
    axes = figure.subplots()
    time = dt * np.arange(length)
    for colour, (name, curve) in zip(PALETTE, curves.items(), strict=False):
        axes.plot(time, curve, color=colour, linewidth=1.0, label=name)
    _draw_bands(axes, time, bands)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("rating")
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    axes.set_title(title)
    return _save(figure, path)
