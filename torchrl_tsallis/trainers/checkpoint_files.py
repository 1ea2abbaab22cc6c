"""The files of checkpoints: what is in them is looked at before anything is loaded, and remains are removed.

TorchRL loads a component by tensordict, which unpickles whatever file of a folder asks for it; a pickle can run any
code. The files of this package's checkpoints hold tensors and JSON alone, so that everything else is refused.
"""

from __future__ import annotations

import json
import re
import shutil
import stat
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

from torchrl_tsallis._torchrl import PLAIN_CLASS
from torchrl_tsallis.jobs import disk_errors

_MANIFEST = "manifest.json"
_MAX_JSON = 2**28  # bytes
_SUFFIXES = (".json", ".memmap")
#: What TorchRL names its unfinished files.
_REMAINS = re.compile(r"^\.(?P<name>.+)\.(?P<kind>stage|archive|backup|delete)-[0-9a-f]{32}$")


class UnsafeCheckpointError(RuntimeError):
    """A checkpoint holds what could run code, or write elsewhere, if it were loaded."""


def _members(path: Path) -> Iterator[tuple[str, int, Callable[[], bytes]]]:
    """Names, sizes and readers of all files of a checkpoint."""
    if path.is_dir():
        for file in sorted(path.rglob("*")):
            name = file.relative_to(path).as_posix()
            if file.is_symlink():
                raise UnsafeCheckpointError(f"{str(path)!r} holds the link {name!r}, which leads out of it")
            if not file.is_dir():
                if not stat.S_ISREG(file.stat().st_mode):
                    raise UnsafeCheckpointError(f"{str(path)!r} holds {name!r}, which is no ordinary file")
                yield name, file.stat().st_size, file.read_bytes
        return
    with zipfile.ZipFile(path) as archive:
        seen = set()
        for info in archive.infolist():
            if info.filename in seen:  # the one that is looked at might not be the one that is loaded
                raise UnsafeCheckpointError(f"{str(path)!r} holds {info.filename!r} twice")
            seen.add(info.filename)
            if not info.is_dir():
                yield info.filename, info.file_size, partial(archive.read, info)


def _leaves(name: str) -> bool:
    """Whether a file's name leads out of the folder that it belongs to."""
    parts = PurePosixPath(name.replace("\\", "/")).parts
    return name.startswith(("/", "\\")) or ".." in parts or ":" in name or "\0" in name


def _unpickled(content: Any) -> bool:
    """Whether a JSON file describes a folder of tensordict's that is not one of tensors alone, or is elsewhere."""
    if not isinstance(content, dict) or "_type" not in content:
        return False
    return content["_type"] != PLAIN_CLASS or any(set(key) & set("/\\") or key in (".", "..") for key in content)


def _paths_that_leave(manifest: Any) -> list[str]:
    """The paths of a manifest's components that lead out of the checkpoint."""
    components = manifest.get("components", {}) if isinstance(manifest, dict) else {}
    records = [record for record in components.values() if isinstance(record, dict)]
    paths = [path for record in records for path in (record.get("path"), *record.get("files", ()))]
    return [path for path in paths if isinstance(path, str) and _leaves(path)]


def check_checkpoint(path: Path) -> None:
    """Refuses a checkpoint that could run code if it were loaded; looks at every file, and loads none.

    Args:
        path: of the checkpoint, a folder or an archive.

    Raises:
        UnsafeCheckpointError: if a file is neither tensors nor JSON, describes an object that is unpickled, is there
            twice, is a link, or has a name that leads out of the checkpoint.
        OSError: if a file cannot be read.
        zipfile.BadZipFile: if the archive is damaged.
        json.JSONDecodeError: if a JSON file is.
    """
    advice = "do not load checkpoints of others; this package's own hold tensors and JSON alone"
    for name, size, read in _members(path):
        if _leaves(name):
            raise UnsafeCheckpointError(f"{str(path)!r} holds {name!r}, which leads out of it: {advice}")
        if not name.endswith(_SUFFIXES):
            raise UnsafeCheckpointError(f"{str(path)!r} holds {name!r}, which is not data and could run code: {advice}")
        if name.endswith(".json"):
            if size > _MAX_JSON:
                raise UnsafeCheckpointError(f"{str(path)!r} holds {name!r} of {size} bytes: {advice}")
            content = json.loads(read())
            if name == _MANIFEST and (away := _paths_that_leave(content)):
                raise UnsafeCheckpointError(f"{str(path)!r} lists {away[0]!r}, which leads out of it: {advice}")
            if _unpickled(content):
                raise UnsafeCheckpointError(
                    f"{str(path)!r} holds {name!r}, whose object is not one of tensors alone and could run code: "
                    f"{advice}"
                )


def read_manifest(path: Path) -> dict[str, Any]:
    """The description of a checkpoint, of whatever version.

    Raises:
        ValueError: if there is none; also of the kinds ``KeyError``, ``OSError`` and ``zipfile.BadZipFile``.
    """
    if path.is_dir():
        content = (path / _MANIFEST).read_bytes()
    else:
        with zipfile.ZipFile(path) as archive:
            content = archive.read(_MANIFEST)
    manifest = json.loads(content)
    if not isinstance(manifest, dict):
        raise ValueError(f"{_MANIFEST} is no JSON object")
    return manifest


def checkpoints_in(folder: Path, prefix: str) -> list[tuple[int, Path]]:
    """The steps and paths of a folder's checkpoints, readable or not, in their order."""
    name = re.compile(rf"{re.escape(prefix)}-(\d+)(\.torchrl)?")
    found = [(match, path) for path in folder.glob(f"{prefix}-*") if (match := name.fullmatch(path.name))]
    return sorted((int(match[1]), path) for match, path in found)


def remove(path: Path) -> None:
    """Removes a file or a folder with all that is in it."""
    with disk_errors(path):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def remove_remains(folder: Path, prefix: str) -> list[Path]:
    """Removes what a killed process has left in a folder of checkpoints.

    A checkpoint that was moved aside, to be replaced, and whose replacement never came is put back.

    Args:
        folder: of the checkpoints.
        prefix: of their names.

    Returns:
        The paths that were removed.

    Raises:
        OSError: if the folder cannot be written; the message names it.
    """
    removed = []
    for path in sorted(folder.glob(f".{prefix}-*")):
        match = _REMAINS.match(path.name)
        if not match:
            continue
        if match["kind"] == "backup" and not (folder / match["name"]).exists():
            with disk_errors(path):
                path.rename(folder / match["name"])
            continue
        remove(path)
        removed.append(path)
    return removed
