"""Folders of ratings as `tsallis rate` leaves them, written by hand."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

SIGNALS = ("knn_residual", "deminf", "jerk", "path_length", "still_share")


def _writer(place):
    def write(episodes: int = 12, *, usable: bool = True, steps: int = 40, names=None, name="ratings", **summary):
        rng = np.random.default_rng(0)
        folder = place / name
        folder.mkdir()
        names = [f"demo_{k}" for k in range(episodes)] if names is None else names
        lengths = rng.integers(max(1, steps // 2), steps + 1, episodes)
        data = {"path": "/data/my demos.npz", "format": "npz", "keys": {"observation": ["obs"], "action": ["act"]}}
        data |= {"identity": "0" * 64, "episodes": episodes, "steps": int(lengths.sum())}
        run = {"format": 1, "kind": "ratings", "method": {"rating": "peak", "u": 0.02}, "data": data}
        run |= {"train": {"steps": 1000, "seeds": 3}, "versions": {"torch": "2.13"}, "command": "tsallis rate <x>"}
        (folder / "run.json").write_text(json.dumps(run))
        said = {
            "usable": usable,
            "reasons": [] if usable else ["the seeds do not agree <b>at all</b>"],
            "agreement": {"spearman": 0.8, "low": 0.7, "high": 0.9},
            "calibration": {"1": 0.2, "2": 0.05, "3": 0.01},
            "u": [0.02, 0.021],
            "findings": [
                {"severity": "warning", "kind": "still", "what": "3 rows <i>stand</i>", "fix": "cut", "where": ""}
            ],
            "sentence": f"Look first at {names[-1]}: 3 episodes are more surprising than the others.",
        }
        (folder / "summary.json").write_text(json.dumps(said | summary))
        surprises = rng.exponential(0.4, int(lengths.sum())).round(4)
        number = np.repeat(np.arange(episodes), lengths)
        surprises[number >= episodes - 3] += 4
        with (folder / "episodes.csv").open("w", newline="", encoding="utf-8") as handle:
            table = csv.writer(handle)
            table.writerow(["episode", "source", "steps", "surprise", "low", "high", *SIGNALS, "return"])
            for k in range(episodes):
                mean = float(surprises[number == k].mean())
                signals = [round(float(rng.random()), 3) for _ in SIGNALS]
                table.writerow([k, names[k], lengths[k], round(mean, 4), mean - 0.3, mean + 0.3, *signals, ""])
        with (folder / "ratings.csv").open("w", newline="") as handle:
            table = csv.writer(handle)
            table.writerow(["row", "episode", "step", "surprise", "rating", "surprise_seen"])
            step = np.concatenate([np.arange(n) for n in lengths])
            table.writerows(
                zip(range(len(step)), number, step, surprises, np.exp(-surprises), surprises / 2, strict=True)
            )
        return folder

    return write


@pytest.fixture
def write_folder(tmp_path):
    """Writes episodes of half to all of so many steps; the last three surprise, the others do not."""
    return _writer(tmp_path)


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    """A folder of 12 episodes and its page, to be read only."""
    from torchrl_tsallis.report import write_report

    folder = _writer(tmp_path_factory.mktemp("reported"))()
    return folder, write_report(folder)
