"""The picture of recipes/ant_modes.py: what the recommended mode's policy is worth beside policies of all episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from torchrl_tsallis.jobs import atomic_path
from torchrl_tsallis.report.figures import new_figure

#: Columns of the picture, from left to right in each cell.
COLOURS = {"BC": "#6b6f76", "proposal": "#e69f00", "peak, tuned": "#0072b2",
           "recommended, by policies": "#cc79a7", "recommended mode": "#009e73"}  # fmt: skip
Cells = Mapping[tuple[str, str, float], Mapping[str, Sequence[float]]]


def draw(cells: Cells, place: Path) -> None:
    """Draws each seed as a point and the median of the seeds as a line, a panel a trio, into a PNG file.

    Args:
        cells: trio, task and noise -> method -> return of each seed.
        place: of the picture.
    """
    trios = sorted({trio for trio, _, _ in cells}, reverse=True)
    figure, axes = new_figure(11, 3.2 * len(trios), rows=len(trios))
    for axis, trio in zip(axes, trios, strict=True):
        own = [key for key in sorted(cells) if key[0] == trio]
        for place_of, key in enumerate(own):
            for k, (method, colour) in enumerate(COLOURS.items()):
                values = [value for value in cells[key].get(method, []) if not np.isnan(value)]
                x = place_of + (k - 2) * 0.16
                axis.plot([x] * len(values), values, "o", color=colour, markersize=4, alpha=0.7, markeredgewidth=0)
                if values:
                    axis.plot([x - 0.06, x + 0.06], [np.median(values)] * 2, color=colour, linewidth=2)
        axis.set_xticks(range(len(own)), [f"{task}\nnoise {std:g}" for _, task, std in own], fontsize=8)
        axis.set(ylabel="return, median of 10 episodes", title=f"trio {trio!r}", ylim=(0, 2800))
        axis.grid(axis="y", linewidth=0.4)
    for method, colour in COLOURS.items():
        axes[0].plot([], [], "o", color=colour, label=method)
    axes[0].legend(fontsize=8, ncols=5, loc="lower right", frameon=False)
    with atomic_path(place) as path:
        figure.savefig(path, format="png", dpi=110, facecolor="white")
