"""What the formats that lie in HDF5 share."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_tsallis.data.readers.base import Column, need, reading

_MAGIC = b"\x89HDF\r\n\x1a\n"


def is_hdf5(path: Path) -> bool:
    """Whether a file is HDF5, or is at least called so."""
    if not path.is_file():
        return False
    if path.suffix.lower() in (".hdf5", ".h5"):
        return True
    try:
        with path.open("rb") as handle:
            return handle.read(8) == _MAGIC
    except OSError:
        return False


@contextmanager
def open_hdf5(path: Path) -> Iterator[Any]:
    """Opens a file to read it; errors while it is open name it."""
    h5py = need("h5py", path)
    with reading(path):
        with path.open("rb"):
            pass  # h5py calls every failure an OSError; the operating system says which
        handle = h5py.File(path, "r")
    with handle:
        try:
            yield handle
        except KeyError as error:
            if str(path) in str(error):  # a reader's own
                raise
            raise ValueError(f"{str(path)!r} is truncated or broken ({error}): copy it again") from error
        except (OSError, RuntimeError) as error:  # h5py's, of what is broken below the file's head
            raise ValueError(
                f"{str(path)!r} is truncated or broken ({error}): copy it again, or record it again"
            ) from error


def datasets(group: Any, prefix: str = "") -> dict[str, Any]:
    """All datasets below a group, by path."""
    out: dict[str, Any] = {}
    for name in group:
        item = group.get(name)
        if not hasattr(item, "keys") and not hasattr(item, "shape"):  # a link to nowhere, or a named type
            continue
        out.update(datasets(item, f"{prefix}{name}/") if hasattr(item, "keys") else {f"{prefix}{name}": item})
    return out


def column(dataset: Any, role: str, image: bool = False) -> Column:
    """The column that a dataset ``[T, *]`` is."""
    shape = tuple(dataset.shape[1:])
    image = image or (dataset.dtype == np.uint8 and len(shape) == 3)
    readable = dataset.dtype.kind in "fiub" or image
    return Column(shape, str(dataset.dtype), role, image, readable and len(dataset.shape) > 0)


def value(group: Any, key: str, name: str, path: Path) -> np.ndarray:
    """Reads one dataset of an episode.

    Raises:
        KeyError: if the episode lacks it.
        ValueError: if its bytes are broken.
    """
    item = group.get(key)
    if item is None or not hasattr(item, "shape"):
        raise KeyError(f"episode {name!r} of {str(path)!r} has no {key!r}, which others have: leave the key out")
    with reading(path):
        return np.asarray(item[()])
