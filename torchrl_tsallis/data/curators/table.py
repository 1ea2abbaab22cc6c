"""npz archives and CSV tables."""

from __future__ import annotations

import csv
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_tsallis.data.curators.base import Curator, Plan, register
from torchrl_tsallis.data.curators.gaps import bounds
from torchrl_tsallis.data.readers.table import NAMES

_RATINGS = ("rating", "surprise")


def _end(names: list[str], plan: Plan) -> tuple[str | None, np.ndarray]:
    """The flag by which an episode is ended anew where its last step is dropped, and the rows that need it."""
    _, last = bounds(plan.lengths, plan.keep_rows)
    true_ends = np.zeros(len(last), dtype=bool)
    true_ends[np.cumsum(plan.lengths) - 1] = True
    flag = next((key for role in ("truncated", "done", "terminated") for key in NAMES[role] if key in names), None)
    return flag, last & ~true_ends


@register
class NpzCurator(Curator):
    """Writes the arrays of the rows that stay, and ``rating`` and ``surprise`` ``[N]``."""

    name = "npz"
    suffixes = (".npz",)

    def __init__(self, plan: Plan) -> None:
        super().__init__(plan)
        with zipfile.ZipFile(plan.source) as archive:
            members = archive.infolist()
        self._keys = [member.filename.removesuffix(".npy") for member in members if member.filename.endswith(".npy")]
        self._compressed = any(member.compress_type != zipfile.ZIP_STORED for member in members)
        if "indices" in self._keys and "acts" in self._keys:
            self.sequence = "imitation's archives hold one observation more an episode than actions"

    def write(self, target: Path) -> None:
        """Writes the archive."""
        plan, columns = self.plan, self.plan.reader.columns()
        out: dict[str, Any] = {}
        with np.load(plan.source, allow_pickle=False) as archive:
            for key in self._keys:
                if columns[key].dtype == "pickled":
                    plan.notes.append(f"{key!r} is left out: it is pickled, and never read")
                else:
                    out[key] = self._take(key, archive[key])
        flag, moved = _end(self._keys, plan)
        if not plan.by_episode and flag is not None:
            out[flag][moved[plan.keep_rows]] = 1
        out |= {"rating": plan.rating[plan.keep_rows], "surprise": plan.surprise[plan.keep_rows]}
        with target.open("wb") as handle:
            (np.savez_compressed if self._compressed else np.savez)(handle, **out)

    def _take(self, key: str, array: np.ndarray) -> np.ndarray:
        plan, rows, episodes = self.plan, len(self.plan.keep_rows), len(self.plan.keep)
        if not array.ndim:
            return array
        if self.sequence is not None:
            if key == "indices":
                return np.cumsum(plan.lengths[plan.keep])[:-1].astype(array.dtype)
            if key == "terminal":
                return array[plan.keep]
            if len(array) == rows + episodes:  # one row more an episode
                return array[np.repeat(plan.keep, plan.lengths + 1)]
        return array[plan.keep_rows] if len(array) == rows else array


@register
class CsvCurator(Curator):
    """Writes the lines that stay as they are, with the columns ``rating`` and ``surprise``."""

    name = "csv"

    def __init__(self, plan: Plan) -> None:
        super().__init__(plan)
        self.suffixes = (plan.source.suffix.lower(),)

    def write(self, target: Path) -> None:
        """Writes the table."""
        plan = self.plan
        with plan.source.open(newline="", encoding="utf-8-sig") as handle:
            first = handle.readline()
            delimiter = max(",;\t", key=first.count)
            handle.seek(0)
            lines = [line for line in csv.reader(handle, delimiter=delimiter) if line]
        header, rows = [name.strip() for name in lines[0]], lines[1:]
        stay = [k for k, name in enumerate(header) if name not in _RATINGS]  # of an earlier rating
        flag, moved = _end(header, plan)
        with target.open("w", newline="", encoding="utf-8") as handle:
            writer = csv.writer(handle, delimiter=delimiter, lineterminator="\n")
            writer.writerow([*(lines[0][k] for k in stay), *_RATINGS])
            for k in np.flatnonzero(plan.keep_rows).tolist():
                cells = list(rows[k])
                if moved[k] and not plan.by_episode and flag is not None:
                    cells[header.index(flag)] = "1"
                values = (f"{values[k]:.6g}" for values in (plan.rating, plan.surprise))
                writer.writerow([*(cells[j] for j in stay), *values])
