"""Readers of the formats in which demonstrations come, found by looking at the path."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

# Each import registers a format; a path looks like one of them at most.
from torchrl_tsallis._checks import check_flag, check_path, shown
from torchrl_tsallis.data.readers import lerobot as _lerobot  # noqa: F401
from torchrl_tsallis.data.readers import minari as _minari  # noqa: F401
from torchrl_tsallis.data.readers import npz as _npz  # noqa: F401
from torchrl_tsallis.data.readers import robomimic as _robomimic  # noqa: F401
from torchrl_tsallis.data.readers import table as _table  # noqa: F401
from torchrl_tsallis.data.readers import ted as _ted  # noqa: F401
from torchrl_tsallis.data.readers.assemble import concatenate_observations
from torchrl_tsallis.data.readers.base import (
    READERS,
    Column,
    Demonstrations,
    Options,
    Provenance,
    RawEpisode,
    Reader,
    naming,
    register,
)
from torchrl_tsallis.data.rows import is_memory_mapped
from torchrl_tsallis.data.schema import check_rows
from torchrl_tsallis.data.storage import as_dtype

_log = logging.getLogger(__name__)

__all__ = [
    "READERS",
    "Column",
    "Demonstrations",
    "Options",
    "Provenance",
    "RawEpisode",
    "Reader",
    "Summary",
    "concatenate_observations",
    "describe",
    "open_reader",
    "read_demonstrations",
    "register",
]


@dataclass(frozen=True)
class Summary:
    """What a file holds, without reading its numbers.

    Args:
        format: name of the format.
        path: the file or folder.
        columns: the entries, by their keys in the file.
        episodes: steps of each episode, by its name.
        pairs: whether the rows are pairs without episodes.
        facts: what else the source says of itself.
    """

    format: str
    path: str
    columns: dict[str, Column]
    episodes: dict[str, int]
    pairs: bool
    facts: dict[str, Any]

    @property
    def steps(self) -> int:
        """Number of all steps."""
        return sum(self.episodes.values())

    def to_json(self) -> dict[str, Any]:
        """The same as a dictionary that ``json`` can write."""
        return asdict(self)


def open_reader(path: str | os.PathLike[str], options: Options | None = None, *, format: str | None = None) -> Reader:
    """Finds the reader of a path.

    Args:
        path: file or folder.
        options: what to read.
        format: name of the format. Default: the first that says that the path looks like it.

    Returns:
        The reader, opened.

    Raises:
        FileNotFoundError: if there is nothing at the path.
        ValueError: if no format is known for it, or it is broken.
    """
    place = Path(check_path("path", path)).expanduser()
    if format is not None and (not isinstance(format, str) or format not in READERS):
        raise ValueError(f"no format {shown(format)}: choose one of {', '.join(READERS)}")
    try:
        if not os.path.exists(place):  # Path.exists() raises for a name that is too long
            raise FileNotFoundError(f"there is nothing at {str(place)!r}: give a file or folder of demonstrations")
        if format is not None:
            return READERS[format](place, options or Options())
        for reader in READERS.values():
            if reader.sniff(place):
                return reader(place, options or Options())
        held = f", a folder of {sorted(x.name for x in place.iterdir())[:5]}" if place.is_dir() else ""
    except PermissionError as error:
        if "no permission" in str(error):
            raise
        raise PermissionError(error.errno, f"no permission to read {str(place)!r}: chmod u+rx, or copy it") from error
    raise ValueError(
        f"{str(place)!r}{held} is none of the formats that can be read ({', '.join(READERS)}): give the data set's own "
        "folder or file, or name the format"
    )


def describe(
    path: str | os.PathLike[str],
    *,
    format: str | None = None,
    filter_key: str | None = None,
    episode: str | None = None,
) -> Summary:
    """Says what a file of demonstrations holds: keys, shapes, episodes.

    Args:
        path: file or folder.
        format: name of the format. Default: found by looking.
        filter_key: subset of its episodes.
        episode: key of the episode's number (npz, CSV).

    Returns:
        The summary.

    Raises:
        FileNotFoundError: if there is nothing at the path.
        ValueError: if no format is known for it, or it is broken.
    """
    reader = open_reader(path, Options(observation=(), filter_key=filter_key, episode=episode), format=format)
    return Summary(reader.name, str(reader.path), reader.columns(), reader.lengths(), reader.pairs, reader.facts())


def read_demonstrations(
    path: str | os.PathLike[str],
    *,
    format: str | None = None,
    observation: str | Sequence[str] | None = None,
    action: str | Sequence[str] | None = None,
    reward: str | None = None,
    episode: str | None = None,
    filter_key: str | None = None,
    images: bool = False,
    next_observation: bool = False,
    concatenate: bool = True,
    dtype: torch.dtype | None = torch.float32,
    check: bool = True,
) -> Demonstrations:
    """Reads demonstrations from a file or folder of any known format into the schema.

    ==============  =====================================================================================
    format          what is read
    ==============  =====================================================================================
    ``lerobot``     folders of LeRobot v2.1 and v3.x, without their videos
    ``minari``      Minari's folders, HDF5 and Arrow
    ``robomimic``   robomimic's HDF5 files
    ``ted``         memory-mapped tensordicts, ``ReplayBuffer.dumps``, this package's safetensors
    ``npz``         D4RL's and ``imitation``'s archives
    ``csv``         tables with a header
    ==============  =====================================================================================

    Args:
        path: file or folder.
        format: name of the format. Default: found by looking at the path.
        observation: keys of the observation in the file, ``*`` for any letters. Default: all vectors that the format
            calls observations.
        action: key of the action, or keys of its columns. Default: what the format calls action.
        reward: key of the reward, which goes to ``("next", "reward")``. Default: what the format calls so.
        episode: key of the episode's number (npz, CSV). Default: what is usually called so.
        filter_key: a mask of robomimic, or a split of LeRobot. Default: all episodes.
        images: whether images are observations too. Default: False, they are read only by name.
        next_observation: whether to read ``("next", "observation")``. Default: False.
        concatenate: whether vectors become one ``observation`` ``[N, O]``. Default: True; False keeps them nested.
        dtype: of the floating-point numbers; a logged notice says where float64 is converted. None keeps what is in the
            file, and what is memory-mapped is never converted. Default: torch.float32, as policies are.
        check: whether observation and action must be finite. Default: True.

    Returns:
        The data ``[N]`` and where it comes from.

    Raises:
        FileNotFoundError: if there is nothing at the path.
        PermissionError: if it may not be read.
        ImportError: if the format's storage library is missing; the message names the extra.
        KeyError: if a key is missing.
        TypeError: if an entry is not made of numbers.
        ValueError: if the format is unknown or broken, or the rows are; the message names file, key and row.

    Examples:
        >>> import tempfile, numpy as np
        >>> file = os.path.join(tempfile.mkdtemp(), "demonstrations.npz")
        >>> ends = np.array([False, False, True, True])
        >>> np.savez(file, observations=np.zeros((4, 3)), actions=np.zeros((4, 2)), terminals=ends)
        >>> data, source = read_demonstrations(file)
        >>> source.format, source.episodes, data["episode"].tolist()
        ('npz', ('0', '1'), [0, 0, 0, 1])
    """
    options = Options(observation, action, reward, episode, filter_key, images, next_observation, concatenate)
    check_flag("check", check)
    if dtype is not None and not (isinstance(dtype, torch.dtype) and dtype.is_floating_point):
        raise TypeError(f"dtype must be a floating-point dtype such as torch.float32, or None, got {shown(dtype)}")
    found = open_reader(path, options, format=format).read()
    if dtype is not None and not is_memory_mapped(found.data):
        info = found.data.get("info", None)
        read = found.data.exclude("info")
        double = [key for key, value in read.items(True, True) if value.dtype == torch.float64]
        if double and dtype != torch.float64:
            _log.warning("%s: %s are float64 and read as %s (dtype=None: as they are)", path, double, dtype)
        data = as_dtype(read, dtype)
        found = found._replace(data=data if info is None else data.set("info", info))
    if check:
        with naming(Path(found.source.path)):
            check_rows(found.data, ["observation", "action"])
    return found
