"""The pictures of a report: each as SVG for the page, and as a PNG file beside it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from torchrl_tsallis.data.ratings_folder import RatingsFolder
from torchrl_tsallis.report import contents, figures
from torchrl_tsallis.report.svg import inline_svg


@dataclass(frozen=True)
class Panel:
    """One picture.

    Args:
        draw: draws it on axes.
        said: what it shows, for those who do not see it.
        width: in inches.
        height: in inches.
        title: above it where several stand in one file.
    """

    draw: Callable[[Any], None]
    said: str
    width: float
    height: float
    title: str = ""

    def svg(self, name: str) -> str:
        """The picture as an element of the page; ids in it begin with the name."""
        figure, (axes,) = figures.new_figure(self.width, self.height)
        self.draw(axes)
        return inline_svg(figure, name, self.said)


def panels(rated: RatingsFolder, calibration: Mapping[int, float]) -> dict[str, list[Panel]]:
    """All pictures; those under one name stand in one PNG file.

    Args:
        rated: the folder of a rating, ``E`` episodes and ``N`` steps.
        calibration: decades -> share of the held-out steps with so many or more.
    """
    mean, low, high = (contents.column(rated, key) for key in ("surprise", "low", "high"))
    marked, order = contents.stand_out(mean, low), contents.order(mean)
    listed = order[: contents.LISTED]
    surprise, seen = rated.steps["surprise"], rated.steps["surprise_seen"]
    by_episode, seen_by_episode = (contents.parts(rated, key) for key in ("surprise", "surprise_seen"))
    out = {
        "strip": [
            Panel(
                partial(figures.draw_strip, surprise=surprise, lengths=rated.lengths),
                f"Strip of all {len(mean)} episodes: the stronger the colour, the greater the surprise of that part",
                9.6,
                2.2,
            )
        ],
        "agreement": [
            Panel(
                partial(
                    figures.draw_agreement, mean=mean[listed], low=low[listed], high=high[listed], marked=marked[listed]
                ),
                f"Surprise of {len(listed)} episodes with 95 % intervals, in falling order",
                3.9,
                2.5,
            )
        ],
        "calibration": [
            Panel(
                partial(figures.draw_calibration, shares=calibration),
                "Share of held-out steps with 1, 2 and 3 decades or more, beside the expected 10, 1 and 0.1 %",
                3.9,
                2.5,
            )
        ],
        "histogram": [
            Panel(
                partial(figures.draw_histogram, surprise=surprise, seen=seen),
                "Number of steps by surprise, of policies that did not and that did see the episode, and as expected",
                3.9,
                2.5,
            )
        ],
        "worst": [
            Panel(
                partial(figures.draw_course, surprise=by_episode[k], seen=seen_by_episode[k]),
                f"Surprise step by step of the episode of rank {rank}",
                3.9,
                1.6,
                f"rank {rank}: episode {k} of the data",
            )
            for rank, k in enumerate(order[: contents.DRAWN].tolist(), 1)
        ],
        "signals": [
            Panel(
                partial(
                    figures.draw_signal,
                    values=contents.column(rated, signal.key),
                    surprise=mean,
                    marked=marked,
                    unit=signal.unit,
                ),
                f"{signal.title} of each episode beside its surprise",
                3.3,
                2.2,
                signal.title,
            )
            for signal in contents.shown(rated)
        ],
    }
    if not calibration:
        del out["calibration"]
    return {name: several for name, several in out.items() if several}


def as_file(several: list[Panel]) -> Any:
    """Pictures as one figure in light colours, at most three in a row."""
    columns = min(len(several), 3 if several[0].width < 3.5 else 2)
    rows = -(-len(several) // columns)
    figure, cells = figures.new_figure(
        several[0].width * columns, (several[0].height + 0.2) * rows, columns=columns, rows=rows
    )
    for axes, panel in zip(cells, several, strict=False):
        panel.draw(axes)
        if len(several) > 1:
            axes.set_title(panel.title, fontsize=9)
    for axes in cells[len(several) :]:
        axes.set_visible(False)
    return figure
