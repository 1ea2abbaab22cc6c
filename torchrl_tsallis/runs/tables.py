"""The tables of a run: one row a step, and one an episode."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchrl_tsallis.data.episodes import Episodes
from torchrl_tsallis.runs.folder import write_csv
from torchrl_tsallis.runs.held_out import HeldOut
from torchrl_tsallis.runs.judgement import interval
from torchrl_tsallis.runs.source import Source

RATINGS = ("row", "episode", "step", "surprise", "rating", "surprise_seen")
SIGNALS = ("knn_residual", "deminf", "jerk", "path_length", "still_share")
EPISODES = ("episode", "source", "steps", "surprise", "low", "high", "share_over_3", "worst_step", *SIGNALS, "return")


def write_tables(
    folder: Path,
    source: Source,
    episodes: Episodes,
    found: HeldOut,
    by_seed: np.ndarray,
    signals: dict[str, Tensor],
) -> None:
    """Writes ``ratings.csv`` and ``episodes.csv``.

    Args:
        folder: of the run.
        source: of the demonstrations.
        episodes: of their rows.
        found: surprises and ratings of the rows.
        by_seed: surprise of each episode by each seed, ``[S, E]``.
        signals: simple signals of each episode, ``[E]``.
    """
    number = episodes.of_rows()
    step = torch.arange(len(number)) - episodes.starts[number]
    surprise, rating = found.surprise.mean(0), found.rating.mean(0)
    columns = [value.tolist() for value in (number, step, surprise, rating, found.seen)]
    write_csv(folder / "ratings.csv", RATINGS, zip(range(len(number)), *columns, strict=True))
    low, high = interval(by_seed)
    reward = source.data.get(("next", "reward"), None)
    rows = []
    for k, (start, length) in enumerate(zip(episodes.starts.tolist(), episodes.lengths.tolist(), strict=True)):
        part = slice(start, start + length)
        over = float((surprise[part] >= 3).double().mean())
        values = [float(signals[name][k]) for name in SIGNALS]
        total = None if reward is None else float(reward[part].double().sum())
        mean = float(by_seed[:, k].mean())
        worst = int(surprise[part].argmax())
        rows.append([k, source.names[k], length, mean, float(low[k]), float(high[k]), over, worst, *values, total])
    write_csv(folder / "episodes.csv", EPISODES, rows)
