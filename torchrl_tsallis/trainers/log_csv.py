"""CSV files of scalars, whose rows are whole or not there."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from torchrl.record.loggers.csv import CSVLogger

from torchrl_tsallis.jobs import atomic_path, disk_errors
from torchrl_tsallis.trainers.log_base import LogAdapter


class CSVAdapter(LogAdapter):
    """A file of ``step,value`` a quantity, whose rows are written as a whole or not at all."""

    def __init__(self, logger: CSVLogger) -> None:
        super().__init__(logger)
        self.scalars = self.folder / "scalars"
        self.next: dict[str, int] = {}

    def scalar(self, name: str, value: float, step: int | None) -> None:
        """Adds a row; without a step, it follows the last one."""
        path = self.scalars / f"{name}.csv"
        with disk_errors(path):
            if name not in self.next:
                path.parent.mkdir(parents=True, exist_ok=True)
                self.next[name] = 1 + _last_step(path)
            step = self.next[name] if step is None else int(step)
            self.next[name] = max(self.next[name], step + 1)
            row = f"{step},{float(value)}\n".encode()
            with path.open("ab", buffering=0) as file:
                start = file.seek(0, os.SEEK_END) if path.is_file() else 0
                try:
                    if file.write(row) < len(row):
                        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                except OSError:
                    if path.is_file():
                        file.truncate(start)
                    raise

    def _paths(self) -> Iterator[tuple[str, Path]]:
        for path in sorted(self.scalars.rglob("*.csv")):
            yield path.relative_to(self.scalars).with_suffix("").as_posix(), path

    def last_step(self) -> int | None:
        """See :meth:`LogAdapter.last_step`."""
        last = max((_last_step(path) for _, path in self._paths()), default=-1)
        return None if last < 0 else last

    def cut(self, step: int, known: Mapping[str, int]) -> dict[str, int]:
        """See :meth:`LogAdapter.cut`; a row that a killed process left unfinished goes too."""
        self.next = {}
        before = {}
        for name, path in self._paths():
            rows = path.read_text(encoding="utf-8").splitlines(keepends=True)
            steps = [_step_of(row) for row in rows]
            before[name] = max((s for s in steps if s is not None), default=-1)
            kept = [row for row, s in zip(rows, steps, strict=True) if s is not None and s <= step]
            if len(kept) < len(rows):
                with atomic_path(path) as temporary:
                    temporary.write_text("".join(kept), encoding="utf-8")
        return before


def _step_of(row: str) -> int | None:
    """The step of a whole row; None for a broken one."""
    first, comma, value = row.partition(",")
    try:
        return int(first) if comma and value.endswith("\n") and [float(value)] else None
    except ValueError:
        return None


def _last_step(path: Path) -> int:
    """The last step of a file of scalars, -1 if it has none."""
    if not path.is_file():
        return -1
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 4096))
        rows = file.read().decode("utf-8", "replace").splitlines(keepends=True)
    return max((s for row in rows if (s := _step_of(row)) is not None), default=-1)
