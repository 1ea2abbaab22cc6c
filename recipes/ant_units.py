"""The bookkeeping of recipes/ant_figure3.py: the table of returns, and the units of work that fill it."""

from __future__ import annotations

import csv
import fcntl
import io
import json
import os
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl_tsallis._io import atomic_path

COLUMNS = ("method", "task", "std", "seed", "episode", "return")
Key = tuple[str, str, float, int]  # method, task, std, seed: one policy


def parse(text: str) -> list[dict[str, Any]]:
    """Rows of a table, each episode once: the first of equal ones counts, and a last line without its end does not."""
    complete = text[: text.rfind("\n") + 1]
    rows: dict[tuple[str, ...], dict[str, Any]] = {}
    for row in csv.DictReader(io.StringIO(complete)):
        values = {"std": float(row["std"]), "seed": int(row["seed"]), "return": float(row["return"])}
        rows.setdefault(tuple(row[name] for name in COLUMNS[:-1]), {**row, **values, "episode": int(row["episode"])})
    return list(rows.values())


def key_of(row: Mapping[str, Any]) -> Key:
    """The policy that a row is of."""
    return row["method"], row["task"], row["std"], row["seed"]


def as_csv(rows: Sequence[Mapping[str, Any]], header: bool = True) -> str:
    """Rows as CSV, returns with three decimals."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, extrasaction="ignore", lineterminator="\n")
    if header:
        writer.writeheader()
    writer.writerows({**row, "std": f"{row['std']:g}", "return": f"{row['return']:.3f}"} for row in rows)
    return text.getvalue()


class ReturnsTable:
    """A CSV file that only grows, by any number of processes; one that dies while it writes costs its last rows alone.

    Args:
        path: the file; it need not exist.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    def read(self) -> list[dict[str, Any]]:
        """The rows ``{method, task, std, seed, episode, return}``."""
        return parse(self.path.read_text(encoding="utf-8")) if self.path.exists() else []

    def counts(self) -> Counter[Key]:
        """How many episodes there are of each policy: they are written in their order, so that the rest is missing."""
        return Counter(map(key_of, self.read()))

    def append(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Adds rows, and returns once they are on the disk."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with open(self.path, "a+b") as file:
                fcntl.flock(file, fcntl.LOCK_EX)
                file.seek(0)
                whole = file.read().rfind(b"\n") + 1
                file.truncate(whole)  # what a process that was killed has left of a line
                file.write(as_csv(rows, header=whole == 0).encode())
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise OSError(
                error.errno,
                f"cannot write {str(self.path)!r} ({error.strerror or error}): check the folder's permissions and the "
                "free space of its disk; complete rows are kept, and the same command goes on after them",
            ) from error


@dataclass(frozen=True)
class Unit:
    """Policies that are trained as one program and then evaluated: all methods of some seeds of a task.

    Attributes:
        folder: of its checkpoints, policies and logs.
        task: one of the paper's four.
        std: of the noise on the experts' commands.
        members: method and seed of each policy.
    """

    folder: Path
    task: str
    std: float
    members: tuple[tuple[str, int], ...]

    @property
    def keys(self) -> list[Key]:
        """Its policies, by the table's columns."""
        return [(method, self.task, self.std, seed) for method, seed in self.members]

    @property
    def begun(self) -> bool:
        """Whether anything is there that is worth to be continued."""
        return (self.folder / "policies.safetensors").exists() or any((self.folder / "checkpoints").glob("*"))

    def save(self) -> None:
        """Writes down which policies are its own."""
        content = {"task": self.task, "std": self.std, "members": self.members}
        with atomic_path(self.folder / "unit.json") as path:
            path.write_text(json.dumps(content))

    @classmethod
    def load(cls, file: Path) -> Unit:
        """Reads what :meth:`save` wrote."""
        content = json.loads(file.read_text())
        members = tuple((method, seed) for method, seed in content["members"])
        return cls(file.parent, content["task"], content["std"], members)


def plan(wanted: Sequence[Key], table: ReturnsTable, output: Path, episodes: int, block: int) -> list[Unit]:
    """The units of work that are left: those that were begun, and new ones for the policies that are in none.

    Args:
        wanted: the policies that are asked for.
        table: what is done.
        output: folder of the units.
        episodes: that each policy has to have.
        block: seeds of a new unit.

    Returns:
        The units with a policy that misses episodes. No policy is in two units.
    """
    counts = table.counts()
    missing = [key for key in wanted if counts[key] < episodes]
    known = [Unit.load(file) for file in sorted(output.glob("std_*/*/*/unit.json"))]
    for unit in [unit for unit in known if not unit.begun]:
        shutil.rmtree(unit.folder)  # to be planned anew, by what is asked for now
        known.remove(unit)
    units = [unit for unit in known if set(unit.keys) & set(missing)]
    taken = {key for unit in known for key in unit.keys}
    groups: dict[tuple[str, float], dict[int, list[str]]] = {}
    for method, task, std, seed in missing:
        if (method, task, std, seed) not in taken:
            groups.setdefault((task, std), {}).setdefault(seed, []).append(method)
    for (task, std), methods in groups.items():
        seeds = sorted(methods)
        for part in (seeds[i : i + block] for i in range(0, len(seeds), block)):
            name, number = f"seeds_{part[0]:02d}-{part[-1]:02d}", 1
            while (folder := output / f"std_{std:g}" / task / f"{name}{f'_{number}' * (number > 1)}").exists():
                number += 1
            unit = Unit(folder, task, std, tuple((method, seed) for seed in part for method in methods[seed]))
            unit.save()
            units.append(unit)
    return units


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Keeps a second run out of a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / ".lock", "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise SystemExit(f"another run works in {folder}: wait for it, or choose another output") from None
        yield
