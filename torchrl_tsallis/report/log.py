"""The ratings of demonstrations in TorchRL's loggers."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from torchrl_tsallis.data.ratings_folder import RatingsFolder
from torchrl_tsallis.report.contents import queue, shown

#: Episodes of a table, of which W&B shows no more.
MOST_ROWS = 10_000


def log_ratings(folder: str | os.PathLike[str], logger: Any, *, name: str = "ratings") -> None:
    """Logs the episodes as a table, the most surprising first, and the surprise of all steps as a histogram.

    W&B and TensorBoard show both. A logger without tables or histograms, as CSV, gets none. Of more than 10,000
    episodes the table has the most surprising ones.

    Args:
        folder: that a rating left.
        logger: any of TorchRL's, or several of them, as :func:`~torchrl_tsallis.trainers.make_logger` makes.
        name: before the names of what is logged: ``<name>/episodes`` and ``<name>/surprise``.

    Raises:
        FileNotFoundError: if the folder or a file in it is not there.
        OSError: if a logger's folder cannot be written.
        ValueError: if a file is broken.
    """
    from torchrl_tsallis.jobs.files import disk_errors
    from torchrl_tsallis.trainers.log_adapters import adapter_of

    rated = RatingsFolder.open(folder)
    columns, rows = _table(rated)
    surprise = rated.steps["surprise"]
    there = surprise[~np.isnan(surprise)]
    for one in getattr(logger, "loggers", [logger]):
        adapter = adapter_of(one)
        with disk_errors(adapter.folder):
            adapter.table(f"{name}/episodes", columns, rows)
            if len(there):
                adapter.histogram(f"{name}/surprise", there, None)


def _table(rated: RatingsFolder) -> tuple[list[str], list[list[Any]]]:
    """Columns and cells; numbers have four digits, and None stands where there is none."""
    signals = [signal.key for signal in shown(rated)]
    columns = ["rank", "episode", "surprise", "low", "high", "share over 3 decades", "worst step", *signals]
    rows = []
    for row in queue(rated, MOST_ROWS):
        place = row["place"]
        numbers = [rated.episodes.get(key, np.full(place + 1, np.nan))[place] for key in ("surprise", "low", "high")]
        cells = [*numbers, row["share"][1], row["worst"][1], *(rated.episodes[key][place] for key in signals)]
        rows.append([row["rank"], row["name"], *map(_cell, cells)])
    return columns, rows


def _cell(value: float) -> float | None:
    return float(f"{value:.4g}") if np.isfinite(value) else None
