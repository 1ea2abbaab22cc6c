"""The folder of a rating, written by hand for data that a reader reads."""

from __future__ import annotations

import csv
import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from torchrl_tsallis.data.readers import open_reader
from torchrl_tsallis.data.readers.base import Options


@pytest.fixture
def write_ratings(tmp_path):
    """Rates a path: an episode's surprise is its number unless given, a step's adds a hundredth of its own."""

    def write(path: Path, surprise=None, *, usable: bool = True, filter_key=None, name: str = "ratings") -> Path:
        options = Options(observation=(), filter_key=filter_key)
        reader = open_reader(path, options)
        lengths = reader.lengths()
        surprise = list(range(len(lengths))) if surprise is None else surprise
        folder = tmp_path / name
        folder.mkdir()
        data = {"path": str(path), "format": reader.name, "keys": {"observation": [], "action": []}}
        run = {"format": 1, "kind": "ratings", "data": data}
        (folder / "run.json").write_text(json.dumps(run))
        summary = {"usable": usable, "reasons": [] if usable else ["the seeds do not agree"]}
        (folder / "summary.json").write_text(json.dumps(summary))
        with (folder / "episodes.csv").open("w", newline="") as handle:
            rows = csv.writer(handle)
            rows.writerow(["episode", "source", "steps", "surprise"])
            rows.writerows(
                [k, n, lengths[n], "" if s is None else s]
                for k, (n, s) in enumerate(zip(lengths, surprise, strict=True))
            )
        with (folder / "ratings.csv").open("w", newline="") as handle:
            rows, row = csv.writer(handle), 0
            rows.writerow(["row", "episode", "step", "surprise", "rating", "surprise_seen"])
            for k, (length, s) in enumerate(zip(lengths.values(), surprise, strict=True)):
                for step in range(length):
                    rows.writerow([row, k, step, (s or 0) + step / 100, 1 / (1 + (s or 0)), s])
                    row += 1
        return folder

    return write


@pytest.fixture
def hashes():
    """Content of every file below a path, as hashes."""

    def of(path: Path) -> dict[str, str]:
        files = [path] if path.is_file() else [file for file in sorted(path.rglob("*")) if file.is_file()]
        return {str(file): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}

    return of


@pytest.fixture
def write_npz(tmp_path):
    """D4RL's keys, four episodes of 3, 4, 2 and 5 steps; the second ends by time, the observation counts rows."""

    def write(**more) -> Path:
        lengths = np.array([3, 4, 2, 5])
        ends = np.cumsum(lengths) - 1
        flags = {key: np.zeros(14, dtype=bool) for key in ("terminals", "timeouts")}
        flags["terminals"][ends[[0, 2, 3]]] = True
        flags["timeouts"][ends[1]] = True
        rows = np.arange(14.0)
        path = tmp_path / "data.npz"
        np.savez(
            path, observations=rows[:, None], actions=-rows[:, None], rewards=rows, name=np.array("x"), **flags, **more
        )
        return path

    return write
