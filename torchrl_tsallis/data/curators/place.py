"""Where a curated copy is written: beside its place, and moved there once it is complete."""

from __future__ import annotations

import errno
import glob
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from torchrl_tsallis.jobs.files import disk_errors

#: What a copy says of how it was made, and what is in the name of a folder that holds an unfinished one.
RECORD, UNFINISHED = "curation.json", ".unfinished-"


def record_of(target: Path) -> Path:
    """Where a copy says how it was made: in its folder, or beside its file."""
    return target / RECORD if target.is_dir() else target.with_name(f"{target.name}.{RECORD}")


def check_place(target: Path, source: Path, folder: Path, suffixes: Sequence[str], overwrite: bool) -> None:
    """Refuses a place where something would be lost.

    Args:
        target: the copy.
        source: the data.
        folder: of the rating.
        suffixes: endings of a file's name, of which the copy's must be one; none for folders.
        overwrite: whether an earlier copy may be replaced.

    Raises:
        FileExistsError: if something is there that may not be replaced.
        ValueError: if the name has another ending, or the copy and its source lie in each other.
    """
    if suffixes and target.suffix.lower() not in suffixes:
        raise ValueError(f"{str(target)!r} must end with {' or '.join(suffixes)}, as the source does")
    place = target.resolve()
    for other, what in ((source, "the data"), (folder, "the rating")):
        there = other.resolve()
        if place == there or there in place.parents or place in there.parents:
            raise ValueError(f"{str(target)!r} and {what}, {str(other)!r}, lie in each other: choose another place")
    if target.exists() or target.is_symlink():
        if not overwrite:
            raise FileExistsError(
                f"there is something at {str(target)!r}: choose another place, or overwrite it by overwrite=True"
            )
        if not record_of(target).is_file():
            raise FileExistsError(f"{str(target)!r} is no curated copy, and is not overwritten: remove it yourself")


@contextmanager
def staged(target: Path) -> Iterator[Path]:
    """Yields a place in a hidden folder beside the target, and moves what is there to it once it is complete.

    An earlier copy stays until then. A killed process leaves the hidden folder, and nothing at the target.

    Raises:
        OSError: if it cannot be written; the message names the target.
    """
    with disk_errors(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{target.name}{UNFINISHED}", dir=target.parent) as scratch:
            stage = Path(scratch) / target.name
            yield stage
            if target.is_dir():  # a folder is not replaced in one step
                os.replace(target, Path(scratch) / "replaced")
            os.replace(stage, target)


def leftovers(target: Path) -> list[Path]:
    """What processes that were killed left beside the target, or others that write it now need."""
    pattern = f".{glob.escape(target.name)}{UNFINISHED}*"
    return sorted(target.parent.glob(pattern)) if target.parent.is_dir() else []


def check_room(target: Path, size: int) -> None:
    """Refuses what does not fit on the disk, where writing through a memory map would end the process without a word.

    Args:
        target: to be written, in a folder that is there.
        size: bytes.

    Raises:
        OSError: if fewer bytes are free.
    """
    free = shutil.disk_usage(target.parent).free
    if size > free:
        raise OSError(errno.ENOSPC, f"{os.strerror(errno.ENOSPC)}: {size:,} bytes are needed, {free:,} are free")
