"""The ratings of demonstrations in TorchRL's loggers."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from torchrl_tsallis.data.ratings_folder import RatingsFolder
from torchrl_tsallis.report.contents import queue


def log_ratings(folder: str | os.PathLike[str], logger: Any, *, name: str = "ratings") -> None:
    """Logs the review queue as a table, and the surprise of all steps as a histogram.

    W&B and TensorBoard show both. A logger without tables or histograms, as CSV, gets none.

    Args:
        folder: that a rating left.
        logger: any of TorchRL's.
        name: before the names of what is logged: ``<name>/episodes`` and ``<name>/surprise``.

    Raises:
        FileNotFoundError: if the folder or a file in it is not there.
        ValueError: if a file is broken.
    """
    from torchrl_tsallis.trainers.log_adapters import adapter_of

    rated = RatingsFolder.open(folder)
    adapter = adapter_of(logger)
    columns = ["rank", "episode", "surprise", "interval", "steps over 3 decades", "worst step"]
    rows = [
        [row["rank"], row["name"], *(row[key][0] for key in ("surprise", "interval", "share", "worst"))]
        for row in queue(rated)
    ]
    adapter.table(f"{name}/episodes", columns, rows)
    surprise = rated.steps["surprise"]
    there = surprise[~np.isnan(surprise)]
    if len(there):
        adapter.histogram(f"{name}/surprise", there, None)
