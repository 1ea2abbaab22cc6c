"""What the formats that lie in Arrow and Parquet share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from torchrl_tsallis.data.readers.base import need, reading


def open_arrow(path: Path) -> Any:
    """Memory-maps an Arrow file as a table, or reads a Parquet file."""
    if path.suffix == ".parquet":
        file = open_parquet(path)
        with reading(path):
            return file.read()
    arrow = need("pyarrow", path)
    ipc = need("pyarrow.ipc", path)
    with reading(path):
        return ipc.open_file(arrow.memory_map(str(path), "r")).read_all()


def open_parquet(path: Path) -> Any:
    """Opens a Parquet file; reads its footer alone."""
    parquet = need("pyarrow.parquet", path)
    with reading(path):
        size = path.stat().st_size
        with path.open("rb") as handle:
            handle.seek(max(0, size - 4))
            if handle.read(4) != b"PAR1":
                raise ValueError(
                    f"{str(path)!r} has no Parquet footer: the recording was not finalised (LeRobot: "
                    "dataset.finalize()), or the copy was cut; record or copy it again"
                )
        return parquet.ParquetFile(str(path))


def read_parquet(path: Path, columns: list[str]) -> Any:
    """Reads some columns of a Parquet file as a table.

    Raises:
        KeyError: if one is missing.
        ValueError: if the file is broken.
    """
    file = open_parquet(path)
    missing = [key for key in columns if key not in file.schema_arrow.names]
    if missing:
        raise KeyError(f"{str(path)!r} has no column {missing[0]!r}, only {sorted(file.schema_arrow.names)}")
    with reading(path):
        return file.read(columns=columns)


def is_binary(kind: Any) -> bool:
    """Whether an Arrow type holds encoded images: bytes, or bytes with a path."""
    name = str(kind)
    return name in ("binary", "large_binary") or name.startswith("struct<bytes: binary")


def columns_of(table: Any) -> dict[str, tuple[tuple[int, ...], Any, bool]]:
    """Shape of a row, Arrow type, and whether it is made of numbers, by key; fields of structs below ``/``."""
    out: dict[str, tuple[tuple[int, ...], Any, bool]] = {}

    def walk(name: str, kind: Any) -> None:
        if str(kind).startswith("struct<") and not is_binary(kind):
            for field in kind:
                walk(f"{name}/{field.name}", field.type)
            return
        shape: tuple[int, ...] = ()
        inner = kind
        while hasattr(inner, "value_type") and "list" in str(inner):
            shape, inner = (*shape, getattr(inner, "list_size", -1)), inner.value_type
        numbers = str(inner) in _NUMBERS
        out[name] = (shape, kind, numbers or is_binary(kind))

    for field in table.schema if hasattr(table, "schema") else table:
        walk(field.name, field.type)
    return out


_NUMBERS = {"bool", "float", "double", "halffloat", *(f"{u}int{n}" for u in ("", "u") for n in (8, 16, 32, 64))}


def array_of(table: Any, key: str, path: Path, name: str | None = None) -> Any:
    """A column as an array ``[T, *]``; images as a list of bytes.

    Raises:
        KeyError: if it is missing.
        ValueError: if rows are missing or differ in length; the message names the first.
    """
    root, *fields = key.split("/")
    if root not in table.column_names:
        raise KeyError(f"{str(path)!r} has no column {root!r}, only {sorted(table.column_names)}")
    chunked = table.column(root)
    for part in fields:
        if not any(field.name == part for field in chunked.type):
            raise KeyError(f"{str(path)!r} has no {key!r}, which others have: leave the key out")
        chunked = need("pyarrow.compute", path).struct_field(chunked, part)
    with reading(path):
        if chunked.null_count:
            row = next(k for k, x in enumerate(chunked.is_null().to_pylist()) if x)
            raise ValueError(
                f"{key!r} of {str(path)!r} has no value at row {row}: remove that row, or leave the key out"
            )
        if is_binary(chunked.type):
            return [x["bytes"] if isinstance(x, dict) else x for x in chunked.to_pylist()]
        parts = [_flat(chunk, key, path) for chunk in chunked.chunks if len(chunk)]
    if not parts:
        return np.zeros((0,))
    if any(part.shape[1:] != parts[0].shape[1:] for part in parts):
        shapes = sorted({part.shape[1:] for part in parts})
        raise ValueError(f"{key!r} of {str(path)!r} has rows of shapes {shapes}: leave the key out")
    return np.concatenate(parts)


def _flat(chunk: Any, key: str, path: Path) -> np.ndarray:
    """A chunk of numbers, or of lists of one length, as an array."""
    kind = str(chunk.type)
    if "list" not in kind:
        return np.asarray(chunk.to_numpy(zero_copy_only=False))
    if kind.startswith("fixed_size_list"):
        inner, width = chunk.flatten(), chunk.type.list_size
    else:
        lengths = np.diff(chunk.offsets.to_numpy())
        inner, width = chunk.flatten(), int(lengths[0])
        other = np.flatnonzero(lengths != width)
        if len(other):
            raise ValueError(
                f"{key!r} of {str(path)!r} has {lengths[other[0]]} numbers at row {other[0]} and {width} at row 0: "
                "remove the rows of another length, or leave the key out"
            )
    if inner.null_count:
        raise ValueError(f"{key!r} of {str(path)!r} has missing numbers within a row: leave the key out")
    values = _flat(inner, key, path)
    return values.reshape(len(chunk), width, *values.shape[1:])
