"""Plain tables: what arrays by key share, and CSV files."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_tsallis.data.episodes import find_episodes
from torchrl_tsallis.data.readers.base import Column, Options, RawEpisode, Reader, naming, one_label, reading, register

#: What entries are usually called, by role.
NAMES = {
    "observation": ("observations", "observation", "obs", "states", "state"),
    "action": ("actions", "action", "acts", "act"),
    "reward": ("rewards", "reward", "rews"),
    "terminated": ("terminals", "terminated", "terminations", "terminal"),
    "truncated": ("timeouts", "truncated", "truncations"),
    "done": ("dones", "done"),
    "timestamp": ("timestamp", "timestamps", "time"),
    "episode": ("episode", "episodes", "episode_index", "episode_id", "traj_id"),
}
ROLES = {
    name: {"terminated": "end", "truncated": "end", "done": "end", "episode": "index", "timestamp": "index"}.get(
        role, role
    )
    for role, names in NAMES.items()
    for name in names
}


def cut(path: Path, flags: dict[str, np.ndarray], number: np.ndarray | None, size: int) -> tuple[Any, np.ndarray]:
    """Starts and lengths of the episodes in a table's flags and numbers, and which of them terminated."""
    data: dict[str, Any] = {
        "next": {key: torch.from_numpy(np.asarray(flag).reshape(-1)) for key, flag in flags.items()}
    }
    if number is not None:
        data["episode"] = torch.from_numpy(np.asarray(number).reshape(-1))
    with naming(path):
        found = find_episodes(TensorDict(data, [size]), open_end=True)
    ends = found.ends.numpy()
    ended = np.zeros(len(ends), dtype=bool)
    for key in ("terminated", *(["done"] if "truncated" not in flags else [])):
        if key in flags:
            ended |= np.asarray(flags[key]).reshape(-1)[ends].astype(bool)
    return found, ended


class Table(Reader):
    """Rows of all episodes one below the other, in arrays by key."""

    takes = frozenset({"episode"})

    def __init__(self, path: Path, options: Options) -> None:
        super().__init__(path, options)
        self._columns = self._describe()
        if options.episode is not None and options.episode not in self._columns:
            raise KeyError(f"{str(path)!r} has no {options.episode!r} for the episode, only {sorted(self._columns)}")
        self._cuts = self._find_cuts()

    def _describe(self) -> dict[str, Column]:
        raise NotImplementedError

    def _array(self, key: str) -> np.ndarray:
        raise NotImplementedError

    def _size(self) -> int:
        """Rows of the table: those of its action."""
        raise NotImplementedError

    def _named(self, role: str) -> str | None:
        return next((key for key in NAMES[role] if key in self._columns and self._columns[key].readable), None)

    def _find_cuts(self) -> list[tuple[str, int, int, bool]]:
        """Name, first row, number of rows of each episode, and whether it terminated."""
        size = self._size()
        if not size:
            raise ValueError(f"{str(self.path)!r} holds no row: nothing was recorded")
        flags = {role: self._array(key) for role in ("terminated", "truncated", "done") if (key := self._named(role))}
        key = self.options.episode or self._named("episode")
        number = None if key is None else self._array(key)
        for name, column in [*flags.items(), *([(key, number)] if number is not None else [])]:
            if np.asarray(column).size != size:
                raise ValueError(f"{name!r} of {str(self.path)!r} has {np.asarray(column).size} rows, actions {size}")
        if not flags and number is None:
            self.pairs = True
            return [("0", 0, size, False)]
        found, ended = cut(self.path, flags, number, size)
        starts = found.starts.tolist()
        names = range(len(starts)) if number is None else [np.asarray(number).reshape(-1)[row].item() for row in starts]
        return [
            (_text(name), start, length, bool(end))
            for name, start, length, end in zip(names, starts, found.lengths.tolist(), ended, strict=True)
        ]

    def columns(self) -> dict[str, Column]:
        """The entries."""
        return self._columns

    def lengths(self) -> dict[str, int]:
        """Rows of each episode."""
        return {name: length for name, _, length, _ in self._cuts}

    def episodes(self, keys: Sequence[str], reward: str | None, following: Sequence[str]) -> Iterator[RawEpisode]:
        """Cuts the arrays into episodes."""
        arrays = {key: self._rows(key) for key in keys}
        rewards = None if reward is None else self._rows(reward)
        clock = self._named("timestamp")
        times = None if clock is None or self._columns[clock].shape else self._rows(clock)
        after = {key: self._following(key) for key in following}
        for name, start, length, ended in self._cuts:
            part = slice(start, start + length)
            yield RawEpisode(
                name,
                {key: array[part] for key, array in arrays.items()},
                None if rewards is None else rewards[part],
                ended,
                {key: array[part] for key, array in after.items()},
                None if times is None else times[part],
            )

    def labels(self, key: str) -> dict[str, str]:
        """Of a column, which may be text."""
        if key not in self._columns:
            raise KeyError(f"{str(self.path)!r} has no {key!r}, only {sorted(self._columns)}")
        cells = self._texts(key)
        if len(cells) != self._size():
            raise ValueError(f"{key!r} of {str(self.path)!r} has {len(cells)} rows, the action {self._size()}")
        return {
            name: one_label(cells[start : start + length], key, name, self.path)
            for name, start, length, _ in self._cuts
        }

    def _texts(self, key: str) -> list[Any]:
        """The cells of a column, as the file has them."""
        array = self._array(key)
        return list(array.reshape(len(array), -1)[:, 0].tolist())

    def _rows(self, key: str) -> np.ndarray:
        array = self._array(key)
        if len(array) != self._size():
            raise ValueError(
                f"{key!r} of {str(self.path)!r} has {len(array)} rows, the action has {self._size()}: they are no pairs"
            )
        return array

    def _following(self, key: str) -> np.ndarray:
        if f"next_{key}" not in self._columns:
            raise KeyError(f"{str(self.path)!r} has no 'next_{key}': leave next_observation out")
        return self._rows(f"next_{key}")


def _text(name: Any) -> str:
    return str(int(name)) if isinstance(name, float) and name.is_integer() else str(name)


@register
class CsvReader(Table):
    """Reads CSV files with a header: one row a step, one column a number.

    Columns are named by the options, with ``*`` for many. Default: those that begin with ``obs`` or ``state`` and with
    ``act``; the episode is the column ``episode`` or one of its usual names.
    """

    name = "csv"
    columns_of_one = True

    @classmethod
    def sniff(cls, path: Path) -> bool:
        """Whether the path is called ``.csv`` or ``.tsv``."""
        return path.is_file() and path.suffix.lower() in (".csv", ".tsv")

    def _describe(self) -> dict[str, Column]:
        with reading(self.path), self.path.open(newline="", encoding="utf-8-sig") as handle:
            first = handle.readline()
            delimiter = max(",;\t", key=first.count)
            handle.seek(0)
            rows = csv.reader(handle, delimiter=delimiter)
            header = [name.strip() for name in next(rows, [])]
            if len(set(header)) < len(header) or not all(header):
                raise ValueError(f"the first line of {str(self.path)!r} must name each column once, it is {header}")
            lines = []
            for number, row in enumerate(rows, 2):
                if row and len(row) != len(header):
                    raise ValueError(
                        f"line {number} of {str(self.path)!r} has {len(row)} cells, the header {len(header)}"
                    )
                if row:
                    lines.append(row)
        self._cells = {name: [line[k] for line in lines] for k, name in enumerate(header)}
        self._numbers: dict[str, np.ndarray] = {}
        return {name: Column((), "float64", _csv_role(name)) for name in header}

    def _array(self, key: str) -> np.ndarray:
        if key not in self._numbers:
            out = np.empty(len(self._cells[key]))
            for row, cell in enumerate(self._cells[key]):
                try:
                    out[row] = _number(cell)
                except ValueError as error:
                    raise ValueError(
                        f"column {key!r} of {str(self.path)!r} holds {cell!r} at row {row}, not a number: correct "
                        "it, or choose other columns"
                    ) from error
            self._numbers[key] = out
        return self._numbers[key]

    def _texts(self, key: str) -> list[Any]:
        return [cell.strip() for cell in self._cells[key]]

    def _size(self) -> int:
        return len(next(iter(self._cells.values()), []))


def _number(cell: str) -> float:
    text = cell.strip().lower()
    return float(text == "true") if text in ("true", "false") else float(text)


def _csv_role(name: str) -> str:
    lowered = name.lower()
    if lowered in ROLES and ROLES[lowered] not in ("observation", "action"):
        return ROLES[lowered]
    if lowered.startswith(("obs", "state")):
        return "observation"
    return "action" if lowered.startswith("act") else "other"
