"""The folder of a rating: which episodes and steps of which data surprised the policies, and how sure that is."""

from __future__ import annotations

import csv
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

_STEPS = ("row", "episode", "step", "surprise", "rating", "surprise_seen")
_EPISODES = ("episode", "source", "steps", "surprise")


@dataclass(frozen=True)
class RatingsFolder:
    """What a folder of ratings holds.

    Args:
        path: the folder.
        run: ``run.json``: data, keys, method, versions, command.
        summary: ``summary.json``: whether the rating is usable and why not, agreement, calibration, findings.
        names: of the episodes in the source, ``[E]``.
        lengths: steps of each episode, ``[E]``.
        episodes: columns of ``episodes.csv``, ``[E]`` each; NaN where a cell is empty.
        steps: columns of ``ratings.csv``, ``[N]`` each, sorted by row.
    """

    path: Path
    run: dict[str, Any]
    summary: dict[str, Any]
    names: tuple[str, ...]
    lengths: np.ndarray
    episodes: dict[str, np.ndarray]
    steps: dict[str, np.ndarray]

    @property
    def starts(self) -> np.ndarray:
        """First row of each episode, ``[E]``."""
        return np.cumsum(self.lengths) - self.lengths

    @property
    def usable(self) -> bool:
        """Whether the rating says of itself that it can be used."""
        return bool(self.summary.get("usable", False))

    @property
    def reasons(self) -> list[str]:
        """Why it cannot be used."""
        return [str(reason) for reason in self.summary.get("reasons") or []]

    @classmethod
    def open(cls, folder: str | os.PathLike[str]) -> RatingsFolder:
        """Reads a folder that a rating left.

        Args:
            folder: with ``run.json``, ``summary.json``, ``episodes.csv`` and ``ratings.csv``.

        Returns:
            Its contents.

        Raises:
            FileNotFoundError: if the folder or a file is not there.
            ValueError: if a file is broken, or the files contradict each other; the message names file and line.
        """
        path = Path(folder).expanduser()
        if not path.is_dir():
            raise FileNotFoundError(
                f"there is no folder {str(path)!r}: rate the data first, and give the rating's folder"
            )
        run, summary = (read_text(path / name) for name in ("run.json", "summary.json"))
        if run.get("kind", "ratings") != "ratings":
            raise ValueError(f"{str(path)!r} is a run of kind {run['kind']!r}, needed is one that rated data: rate it")
        if run.get("format", 1) != 1:
            raise ValueError(f"{str(path)!r} has the format {run['format']!r}, needed is 1: rate the data again")
        if not isinstance(run.get("data"), dict):
            raise ValueError(f"{str(path / 'run.json')!r} does not say which data were rated: rate them again")
        file = path / "episodes.csv"
        cells = read_table(file, _EPISODES)
        names = tuple(cells.pop("source"))
        episodes = {key: numbers_of(file, key, column) for key, column in cells.items()}
        lengths = episodes["steps"]
        if not len(names):
            raise ValueError(f"{str(file)!r} names no episode: rate the data again")
        if len(set(names)) < len(names) or not (lengths == lengths.round()).all() or not (lengths >= 1).all():
            raise ValueError(
                f"{str(file)!r} must name each episode once, with its number of steps: rate the data again"
            )
        file = path / "ratings.csv"
        steps = {key: numbers_of(file, key, column) for key, column in read_table(file, _STEPS).items()}
        order = np.argsort(steps["row"], kind="stable")
        steps = {key: column[order] for key, column in steps.items()}
        out = cls(path, run, summary, names, lengths.astype(np.int64), episodes, steps)
        expected = {
            "row": np.arange(int(lengths.sum())),
            "episode": np.repeat(episodes["episode"], out.lengths),
            "step": np.arange(int(lengths.sum())) - np.repeat(out.starts, out.lengths),
        }
        for key, column in expected.items():
            if len(column) != len(steps[key]) or not np.array_equal(column, steps[key]):
                raise ValueError(
                    f"{key!r} of {str(file)!r} is not what episodes.csv says ({len(steps[key])} rows, {len(column)} "
                    "steps): the files are of two ratings; rate the data again"
                )
        return out


def read_text(file: Path) -> dict[str, Any]:
    """An object of JSON; what is wrong with it is said with the file's name."""
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise FileNotFoundError(
            error.errno, f"{str(file)!r} is not there: give the folder of a rating, or rate the data again"
        ) from error
    except ValueError as error:
        raise ValueError(f"{str(file)!r} is broken ({error}): rate the data again") from error
    if not isinstance(found, dict):
        raise ValueError(f"{str(file)!r} is {type(found).__name__}, needed is an object: rate the data again")
    return found


def read_table(file: Path, needed: tuple[str, ...]) -> dict[str, list[str]]:
    """Columns of a CSV file that has at least the needed ones."""
    try:
        with file.open(newline="", encoding="utf-8") as handle:
            rows = list(csv.reader(handle))
    except FileNotFoundError as error:
        raise FileNotFoundError(
            error.errno, f"{str(file)!r} is not there: give the folder of a rating, or rate the data again"
        ) from error
    except (ValueError, csv.Error) as error:
        raise ValueError(f"{str(file)!r} is broken ({error}): rate the data again") from error
    header = rows[0] if rows else []
    missing = [key for key in needed if key not in header]
    if missing:
        raise ValueError(f"{str(file)!r} has no column {missing[0]!r}, only {header}: rate the data again")
    for number, row in enumerate(rows[1:], 2):
        if len(row) != len(header):
            raise ValueError(
                f"line {number} of {str(file)!r} has {len(row)} cells, the header {len(header)}: rate the data again"
            )
    return {key: [row[k] for row in rows[1:]] for k, key in enumerate(header)}


def numbers_of(file: Path, key: str, cells: list[str]) -> np.ndarray:
    """A column as numbers, ``[N]``; NaN where a cell is empty."""
    out = np.full(len(cells), np.nan)
    for k, cell in enumerate(cells):
        try:
            out[k] = float(cell) if cell else np.nan
        except ValueError as error:
            raise ValueError(
                f"column {key!r} of {str(file)!r} holds {cell!r} at line {k + 2}, not a number: rate the data again"
            ) from error
    return out
