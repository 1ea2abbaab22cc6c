"""Figures of page flipping."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from torchrl_tsallis._io import atomic_path
from torchrl_tsallis.evaluation.plots import PALETTE


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

    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 4.6), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
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
    upper.set_ylabel("exerted force [N]")
    upper.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    lower.set_ylabel("angle of pages [deg]")
    lower.set_xlabel("time [s]; dashed: a page turned over")
    upper.set_title(title)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")
    return Path(path)
