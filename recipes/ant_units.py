"""The bookkeeping of the sweeps on the Ant: the table of returns, and the units of work that fill it."""

from __future__ import annotations

import csv
import fcntl
import io
import json
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from torchrl_tsallis.jobs import atomic_path

COLUMNS = ("method", "trio", "task", "std", "scale", "seed", "episode", "return")
FORMATS = {"std": float, "scale": float, "seed": int, "episode": int, "return": float}


class Key(NamedTuple):
    """One policy.

    Attributes:
        method: name of it in the configuration.
        task: of the corruptions.
        std: of the noise on the experts' commands.
        seed: of the corruptions, the network and the order of the samples.
        trio: who demonstrates, a name in the configuration.
        scale: factor of the actions, whose unit it changes.
    """

    method: str
    task: str
    std: float
    seed: int
    trio: str = "own"
    scale: float = 1.0


def parse(text: str) -> list[dict[str, Any]]:
    """Rows of a table, each episode once: the first of equal ones counts, and a last line without its end does not."""
    complete = text[: text.rfind("\n") + 1]
    rows: dict[tuple[str, ...], dict[str, Any]] = {}
    for read in csv.DictReader(io.StringIO(complete)):
        row = {**Key._field_defaults, **read}  # a table may have no columns for what does not vary in it
        row |= {name: kind(row[name]) for name, kind in FORMATS.items()}
        rows.setdefault(tuple(row[name] for name in COLUMNS[:-1]), row)
    return list(rows.values())


def key_of(row: Mapping[str, Any]) -> Key:
    """The policy that a row is of."""
    return Key(*(row[name] for name in Key._fields))


def as_csv(rows: Sequence[Mapping[str, Any]], header: bool = True, columns: Sequence[str] = COLUMNS) -> str:
    """Rows as CSV, returns with three decimals."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    if header:
        writer.writeheader()
    digits = {"std": "g", "scale": "g", "return": ".3f"}
    writer.writerows({**row, **{name: format(row[name], kind) for name, kind in digits.items()}} for row in rows)
    return text.getvalue()


class ReturnsTable:
    """A CSV file that only grows, by any number of processes; one that dies while it writes costs its last rows alone.

    Args:
        path: the file; it need not exist.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    def read(self) -> list[dict[str, Any]]:
        """The rows, by the columns' names."""
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
    """Policies that are trained as one program and then evaluated: methods of one kind, of some seeds of a condition.

    Attributes:
        folder: of its checkpoints, policies and logs.
        keys: its policies, alike but for method and seed.
    """

    folder: Path
    keys: tuple[Key, ...]

    @property
    def condition(self) -> Key:
        """What its policies have in common: task, std, trio and scale."""
        return self.keys[0]

    @property
    def members(self) -> list[tuple[str, int]]:
        """Method and seed of each policy."""
        return [(key.method, key.seed) for key in self.keys]

    @property
    def begun(self) -> bool:
        """Whether anything is there that is worth to be continued."""
        return (self.folder / "policies.safetensors").exists() or any((self.folder / "checkpoints").glob("*"))

    def save(self) -> None:
        """Writes down which policies are its own."""
        with atomic_path(self.folder / "unit.json") as path:
            path.write_text(json.dumps([key._asdict() for key in self.keys]))

    @classmethod
    def load(cls, file: Path) -> Unit:
        """Reads what :meth:`save` wrote."""
        return cls(file.parent, tuple(Key(**key) for key in json.loads(file.read_text())))


def plan(
    wanted: Sequence[Key],
    table: ReturnsTable,
    output: Path,
    episodes: int,
    block: int,
    kind_of: Callable[[str], str] = lambda method: "",
) -> list[Unit]:
    """The units of work that are left: those that were begun, and new ones for the policies that are in none.

    Args:
        wanted: the policies that are asked for.
        table: what is done.
        output: folder of the units.
        episodes: that each policy has to have.
        block: seeds of a new unit.
        kind_of: of a method; methods of different kinds are not trained as one program. Default: all are of one kind.

    Returns:
        The units with a policy that misses episodes. No policy is in two units.
    """
    counts = table.counts()
    missing = [key for key in wanted if counts[key] < episodes]
    known = [Unit.load(file) for file in sorted(output.glob("*/std_*/*/*/unit.json"))]
    for unit in [unit for unit in known if not unit.begun]:
        shutil.rmtree(unit.folder)  # to be planned anew, by what is asked for now
        known.remove(unit)
    units = [unit for unit in known if set(unit.keys) & set(missing)]
    taken = {key for unit in known for key in unit.keys}
    groups: dict[tuple[Key, str], dict[int, list[Key]]] = {}
    for key in missing:
        if key not in taken:
            group = (key._replace(method="", seed=0), kind_of(key.method))
            groups.setdefault(group, {}).setdefault(key.seed, []).append(key)
    for (condition, _), policies in groups.items():
        place = f"{condition.trio}/std_{condition.std:g}"
        place += f"/{condition.task}" + f"_scale_{condition.scale:g}" * (condition.scale != 1)
        seeds = sorted(policies)
        for part in (seeds[i : i + block] for i in range(0, len(seeds), block)):
            name, number = f"seeds_{part[0]:02d}-{part[-1]:02d}", 1
            while (folder := output / place / f"{name}{f'_{number}' * (number > 1)}").exists():
                number += 1
            unit = Unit(folder, tuple(key for seed in part for key in policies[seed]))
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
