"""The folder of a run: it appears whole, or not at all."""

from __future__ import annotations

import csv
import io
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
#: What a run, its report and its card consist of; pictures and logs are recognised by their endings.
FILES = (RUN, "policy.safetensors", "rating.safetensors", "target.safetensors", "scaling.json")
TABLES = ("ratings.csv", "episodes.csv", "summary.json")
#: What a search for modes leaves beside run.json and summary.json.
OF_MODES = ("modes.csv", "labels.csv", "differences.csv", "pairs.safetensors", "modes.html")
_OTHERS, _ENDINGS = ("report.html", "README.md"), (".png", ".svg")


def check_free(out: str | os.PathLike[str], overwrite: bool, source: str | os.PathLike[str] | None = None) -> Path:
    """The folder to write, if nothing would be lost.

    Args:
        out: the folder.
        overwrite: whether an earlier run there may be replaced.
        source: file or folder of the data that are read; neither may lie in the other.

    Raises:
        FileExistsError: if something is there, and it is no run, or more than one, or ``overwrite`` was not given.
        ValueError: if ``out`` lies in ``source``, or ``source`` in ``out``.
    """
    place = Path(out).expanduser()
    if source is not None:
        ours, theirs = place.resolve(), Path(source).expanduser().resolve()
        if ours == theirs or ours in theirs.parents or theirs in ours.parents:
            raise ValueError(f"{str(place)!r} and the data {str(source)!r} lie in one another: choose another output")
    empty = place.is_dir() and not any(place.iterdir())
    if not (place.exists() or place.is_symlink()) or empty:
        return place
    if not (place.is_dir() and (place / RUN).is_file()):
        raise FileExistsError(f"{str(place)!r} exists and is no run: choose another output folder")
    if not overwrite:
        raise FileExistsError(
            f"{str(place)!r} holds a run: choose another output folder, or replace it (overwrite=True, --overwrite)"
        )
    known = {*FILES, *TABLES, *OF_MODES, *_OTHERS}
    others = sorted(x.name for x in place.iterdir() if x.name not in known and x.suffix not in _ENDINGS)
    if others:
        raise FileExistsError(f"{str(place)!r} holds more than a run ({', '.join(others[:3])}): move that first")
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
        FileExistsError: if something is there, see :func:`check_free`.
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
            _put(working, place)
    finally:
        if working is not None:
            shutil.rmtree(working, ignore_errors=True)


def _put(new: Path, place: Path) -> None:
    """Renames ``new`` to ``place``; what was there is removed afterwards, or is there again if that fails."""
    old: Path | None = None
    if place.exists():
        old = Path(tempfile.mkdtemp(prefix=f".{place.name}-old-", dir=place.parent))
    try:
        if old is not None:
            os.replace(place, old)
        os.replace(new, place)
    finally:
        if old is not None:
            if not place.exists():
                os.replace(old, place)
            shutil.rmtree(old, ignore_errors=True)


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


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Names the file, and what to do, where it cannot be read."""
    try:
        yield
    except FileNotFoundError as error:
        run, inside = path.parent / RUN, path.name != RUN
        whole = inside and run.is_file()
        advice = "make the run again" if whole else "give the folder of a run, as `tsallis rate` leaves it"
        raise FileNotFoundError(error.errno, f"{str(path)!r} is not there: {advice}") from error
    except OSError as error:
        raise OSError(error.errno, f"cannot read {str(path)!r} ({error.strerror}): check its permissions") from error
    except (UnicodeDecodeError, json.JSONDecodeError, csv.Error) as error:
        raise ValueError(f"{str(path)!r} is broken ({error}): make the run again") from error


def read_json(path: Path) -> dict[str, Any]:
    """Reads an object of a file of JSON.

    Raises:
        FileNotFoundError: if it is not there.
        OSError: if it cannot be read.
        ValueError: if it is none.
    """
    with _reading(path):
        value = json.loads(path.read_text(encoding="utf-8"))
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


def read_csv(path: Path, header: Sequence[str], rows: int | None = None) -> list[dict[str, str]]:
    """Reads a table, one dictionary a row.

    Args:
        path: of the table.
        header: columns that it must have.
        rows: how many it must have. Default: not checked.

    Raises:
        FileNotFoundError: if it is not there.
        OSError: if it cannot be read.
        ValueError: if columns, rows or cells are missing.
    """
    with _reading(path):
        text = path.read_bytes().decode()
        lines = list(csv.reader(io.StringIO(text, newline="")))
    names = lines[0] if lines else []
    wrong = [number for number, cells in enumerate(lines[1:], 2) if len(cells) != len(names)]
    missing = [key for key in header if key not in names]
    reason = ""
    if missing:
        reason = f"has no column {missing[0]!r}"
    elif wrong:
        reason = f"has {len(lines[wrong[0] - 1])} cells in line {wrong[0]}, where the header has {len(names)}"
    elif rows not in (None, len(lines) - 1) or not text.endswith("\n"):
        reason = f"ends after {len(lines) - 1} rows" + (
            f", {RUN} says {rows}" if rows is not None else " without an end"
        )
    if reason:
        raise ValueError(f"{str(path)!r} {reason}: make the run again")
    return [dict(zip(names, cells, strict=True)) for cells in lines[1:]]
