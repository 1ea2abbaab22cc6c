"""Rows of demonstrations in pieces, so that data on disk may be larger than the memory.

A memory-mapped tensor costs no anonymous memory until something makes a whole one of it. What reads demonstrations
therefore goes through :func:`pieces`, and what writes them through :func:`store_rows` or :func:`map_rows`.
"""

from __future__ import annotations

import os
import shutil
import socket
import tempfile
import weakref
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import torch
from tensordict import MemoryMappedTensor, TensorDict, TensorDictBase
from torch import Tensor

from torchrl_tsallis.jobs.files import disk_errors

#: Bytes of a piece; what is computed of one takes a few times as much, far below 64 MiB.
PIECE = 2 * 2**20
_WRITING, _ROWS = ".writing", "rows"


def pieces(size: int, row_bytes: int) -> Iterator[slice]:
    """Ranges of rows of about :data:`PIECE` bytes each.

    Args:
        size: number of rows N.
        row_bytes: bytes a row.

    Yields:
        Slices that cover ``[0, N)`` in order.

    Examples:
        >>> [(part.start, part.stop) for part in pieces(10, PIECE // 4)]
        [(0, 4), (4, 8), (8, 10)]
    """
    step = max(1, PIECE // max(1, row_bytes))
    for start in range(0, size, step):
        yield slice(start, min(size, start + step))


def row_bytes(value: Tensor | TensorDictBase) -> int:
    """Bytes of one row of a tensor ``[N, *]``, or of a tensordict ``[N]``."""
    tensors = value.values(True, True) if isinstance(value, TensorDictBase) else [value]
    return max(1, sum(x.element_size() * x[0].numel() for x in tensors if len(x)))


def is_memory_mapped(data: TensorDictBase) -> bool:
    """Whether every entry of a tensordict lies in a memory map, as those that ``TensorDict.load_memmap`` gives.

    Examples:
        >>> data = TensorDict({"action": torch.zeros(4, 2)}, [4])
        >>> is_memory_mapped(data), is_memory_mapped(data.memmap())
        (False, True)
    """
    leaves = list(data.values(True, True))
    return bool(leaves) and all(isinstance(leaf, MemoryMappedTensor) for leaf in leaves)


def _on_disk(data: TensorDictBase) -> bool:
    """Whether some entry lies in a memory map, and the rows are more than a piece."""
    mapped = any(isinstance(leaf, MemoryMappedTensor) for leaf in data.values(True, True))
    return mapped and row_bytes(data) * len(data) > PIECE


def _allocate(row: TensorDictBase, size: int, folder: str | None) -> TensorDictBase:
    """An empty memory map ``[size]`` of rows like ``row`` ``[1]``; without a folder in shared memory."""
    with disk_errors(folder or "shared memory"):
        out = TensorDict(row.to_dict(), [1]).expand(size).memmap_like(prefix=folder)
        if folder is not None and hasattr(os, "posix_fallocate"):
            for file in Path(folder).rglob("*.memmap"):  # a full disk is an error now, and a killed process later
                with file.open("r+b") as handle:
                    if length := os.fstat(handle.fileno()).st_size:
                        os.posix_fallocate(handle.fileno(), 0, length)
        return out


def _copy(source: TensorDictBase, target: TensorDictBase, start: int) -> None:
    for key in target.keys(True, True):
        value, out = source[key], target[key]
        for part in pieces(len(value), row_bytes(value)):
            out[start + part.start : start + part.stop].copy_(value[part])


def _same(source: TensorDictBase, target: TensorDictBase, start: int) -> bool:
    return all(
        torch.equal(target[key][start + part.start : start + part.stop], source[key][part].to(target[key].dtype))
        for key in target.keys(True, True)
        for part in pieces(len(source[key]), row_bytes(source[key]))
    )


def _alive(host: str, process: str) -> bool:
    """Whether the process that writes may still run; one of another machine may."""
    if host != socket.gethostname() or not process.isdigit():
        return True
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


def _kept(folder: Path, parts: Sequence[TensorDictBase], like: TensorDictBase, size: int) -> TensorDictBase | None:
    """The same rows as an earlier start left them, if there are any."""
    for found in sorted(folder.glob(f"{_ROWS}-*")):
        try:
            old = TensorDict.load_memmap(found, allow_pickle=False)
            shapes = {key: (value.shape[1:], value.dtype) for key, value in old.items(True, True)}
        except Exception:  # whatever lies there, it is not what this function wrote
            continue
        wanted = {key: (value.shape[1:], value.dtype) for key, value in like.items(True, True)}
        if old.shape != (size,) or shapes != wanted:
            continue
        start, same = 0, True
        for part in parts:
            same = same and _same(part, old, start)
            start += len(part)
        if same:
            return old
    return None


def store_rows(
    parts: Sequence[TensorDictBase],
    *,
    scratch_dir: str | os.PathLike[str] | None = None,
    convert: Callable[[TensorDictBase], TensorDictBase] = lambda rows: rows,
) -> TensorDictBase:
    """Puts rows, one part after the other, into one memory map.

    In ``scratch_dir`` each set of rows has a folder ``rows-*`` of its own that appears whole or not at all. A script
    that is started again finds the rows that it stored before and uses them; it never writes into what another start
    may still be reading. What a killed start left half-written is removed.

    Args:
        parts: tensordicts ``[N_k]`` with the same entries.
        scratch_dir: folder of the memory map; it may exist. Default: shared memory.
        convert: makes rows ``[1]`` of the dtypes to store from rows ``[1]``.

    Returns:
        The rows, ``[sum N_k]``.

    Raises:
        OSError: if the folder cannot be written; the message names it.

    Examples:
        >>> parts = [TensorDict({"action": torch.full((n, 1), float(n))}, [n]) for n in (1, 2)]
        >>> store_rows(parts)["action"][:, 0].tolist()
        [1.0, 2.0, 2.0]
    """
    size = sum(len(part) for part in parts)
    like = convert(parts[0][:1].clone())
    if scratch_dir is None:
        out = _allocate(like, size, None)
        _fill(parts, out)
        return out
    folder = Path(scratch_dir)
    working: Path | None = None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for left in folder.glob(f"{_WRITING}-*"):
            if not _alive(*left.name.split("-", 1)[1].rsplit("-", 2)[:2]):
                shutil.rmtree(left, ignore_errors=True)
        found = _kept(folder, parts, like, size)
        if found is not None:
            return found
        working = Path(tempfile.mkdtemp(prefix=f"{_WRITING}-{socket.gethostname()}-{os.getpid()}-", dir=folder))
        _fill(parts, _allocate(like, size, str(working)))
        target = folder / f"{_ROWS}-{working.name.rsplit('-', 1)[1]}"
        os.rename(working, target)
        working = None
        return TensorDict.load_memmap(target, allow_pickle=False)
    except OSError as error:
        raise OSError(
            error.errno,
            f"cannot store the demonstrations in scratch_dir={str(folder)!r} ({error.strerror or error}): check the "
            f"folder's permissions and that {size * row_bytes(like) / 2**20:.0f} MiB are free, or choose another",
        ) from error
    finally:
        if working is not None:
            shutil.rmtree(working, ignore_errors=True)


def _fill(parts: Sequence[TensorDictBase], out: TensorDictBase) -> None:
    start = 0
    for part in parts:
        _copy(part, out, start)
        start += len(part)


def map_rows(function: Callable[[TensorDictBase], TensorDictBase], data: TensorDictBase) -> TensorDictBase:
    """Applies a function of rows; to memory-mapped data piece by piece, into a memory map in a temporary folder.

    Args:
        function: maps rows ``[n]`` to rows ``[n]``, each by itself.
        data: ``[N]``, or of any batch size where it is not memory-mapped.

    Returns:
        ``function(data)``.

    Raises:
        OSError: if the temporary folder has no room; ``TMPDIR`` chooses another disk.
    """
    if data.ndim != 1 or not _on_disk(data):
        return function(data)
    return _temporary(function(data[:1]), len(data), lambda part: function(data[part]), row_bytes(data))


def take_rows(data: TensorDictBase, mask: Tensor) -> TensorDictBase:
    """The rows where a mask ``[N]`` is set; of memory-mapped data as a memory map in a temporary folder.

    Args:
        data: ``[N]``.
        mask: ``[N]`` bool.

    Returns:
        ``data[mask]``.

    Raises:
        OSError: if the temporary folder has no room; ``TMPDIR`` chooses another disk.
    """
    if not _on_disk(data):
        return data[mask]
    rows = mask.nonzero()[:, 0]
    return _temporary(data[:1], len(rows), lambda part: data[rows[part]], row_bytes(data))


def _temporary(like: TensorDictBase, size: int, read: Callable[[slice], TensorDictBase], step: int) -> TensorDictBase:
    """A memory map ``[size]`` in a temporary folder that goes with it, filled from pieces of ``step`` bytes a row."""
    folder = tempfile.mkdtemp(prefix="torchrl-tsallis-")
    try:
        out = _allocate(like, size, folder)
        for part in pieces(size, step):
            rows = read(part)
            for key in out.keys(True, True):
                out[key][part].copy_(rows[key])
    except OSError as error:
        shutil.rmtree(folder, ignore_errors=True)
        raise OSError(
            error.errno, f"cannot write rows to {folder!r} ({error}): set TMPDIR to a folder of a disk with more room"
        ) from error
    weakref.finalize(out, shutil.rmtree, folder, True)  # the mapping outlives its files
    return out
