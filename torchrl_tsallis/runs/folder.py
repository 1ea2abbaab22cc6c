"""The folder of a run: it appears whole, or not at all."""

from __future__ import annotations

import csv
import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torchrl_tsallis.jobs.files import atomic_path, disk_errors

#: The file that makes a folder a run, and the format that this package writes.
RUN, FORMAT = "run.json", 1


def check_free(out: str | os.PathLike[str], overwrite: bool) -> Path:
    """The folder to write, if nothing would be lost.

    Raises:
        FileExistsError: if something is there, and it is no run or ``overwrite`` was not given.
    """
    place = Path(out).expanduser()
    empty = place.is_dir() and not any(place.iterdir())
    if not (place.exists() or place.is_symlink()) or empty:
        return place
    if not (place.is_dir() and (place / RUN).is_file()):
        raise FileExistsError(f"{str(place)!r} exists and is no run: choose another output folder")
    if not overwrite:
        raise FileExistsError(f"{str(place)!r} holds a run: choose another output folder, or overwrite=True")
    return place


@contextmanager
def new_folder(out: str | os.PathLike[str], *, overwrite: bool = False) -> Iterator[Path]:
    """Yields a hidden folder beside ``out`` that takes its name once the block has succeeded.

    Args:
        out: the folder to write. One that is empty may be there.
        overwrite: whether an earlier run there is replaced, at the very end.

    Yields:
        The folder to write to.

    Raises:
        FileExistsError: if something is there, and it is no run or ``overwrite`` was not given.
        OSError: if it cannot be written.
    """
    place = check_free(out, overwrite)
    working: Path | None = None
    try:
        with disk_errors(place):
            place.parent.mkdir(parents=True, exist_ok=True)
            working = Path(tempfile.mkdtemp(prefix=f".{place.name}-", dir=place.parent))
        yield working
        check_free(place, overwrite)
        with disk_errors(place):
            umask = os.umask(0)
            os.umask(umask)
            working.chmod(0o777 & ~umask)  # mkdtemp's folders are the user's alone
            old: Path | None = None
            if place.exists():
                old = Path(tempfile.mkdtemp(prefix=f".{place.name}-old-", dir=place.parent))
                os.replace(place, old)
            os.replace(working, place)
            working = None
            if old is not None:
                shutil.rmtree(old, ignore_errors=True)
    finally:
        if working is not None:
            shutil.rmtree(working, ignore_errors=True)


def plain(value: Any) -> Any:
    """The same with None for what JSON has no number for."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_json(path: Path, value: Any) -> None:
    """Writes a file of JSON; what is NaN or infinite becomes null."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(plain(value), indent=1) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """Reads an object of a file of JSON.

    Raises:
        FileNotFoundError: if it is not there.
        ValueError: if it is none.
    """
    try:
        value = json.loads(path.read_text())
    except FileNotFoundError:
        raise FileNotFoundError(f"{str(path)!r} is not there: give the folder that `tsallis rate` made") from None
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{str(path)!r} is broken ({error}): make the run again") from error
    if not isinstance(value, dict):
        raise ValueError(f"{str(path)!r} holds no object: make the run again")
    return value


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Writes a table; numbers get six digits, and what is None or NaN stays empty."""

    def cell(value: Any) -> Any:
        if not isinstance(value, float):
            return "" if value is None else value
        return f"{value:.6g}" if math.isfinite(value) else ""

    with atomic_path(path) as temporary, temporary.open("w", newline="") as handle:
        writer = csv.writer(handle, lineterminator="\n")
        writer.writerow(header)
        writer.writerows([cell(value) for value in row] for row in rows)


def read_csv(path: Path) -> list[dict[str, str]]:
    """Reads a table, one dictionary a row.

    Raises:
        FileNotFoundError: if it is not there.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{str(path)!r} is not there: `tsallis rate` writes it, `tsallis train` does not")
    with path.open(newline="") as handle:
        return list(csv.DictReader(handle))
