"""What a reader of a file format is, and the registry in which the formats are found by looking at a path.

TorchRL has readers of some of these formats. Its Minari reader (0.14.1) gives zeros for local data and its LeRobot
reader refuses local folders, so files are read by the formats' storage libraries alone: h5py and pyarrow.
"""

from __future__ import annotations

import importlib
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from tensordict import TensorDictBase

from torchrl_tsallis._checks import check_flag


@dataclass(frozen=True)
class Options:
    """What to read of a file; keys are those of the file, and may hold ``*``.

    Args:
        observation: keys of the observation. Default: all vectors that the format calls observations.
        action: key of the action, or keys of its columns. Default: what the format calls action.
        reward: key of the reward. Default: what the format calls so.
        episode: key of the episode's number (npz, CSV). Default: what is usually called so.
        filter_key: subset by the file's own name: a mask of robomimic, a split of LeRobot.
        images: whether images count as observations where ``observation`` is not given.
        next_observation: whether to read the observations after each step too.
        concatenate: whether vectors become one ``observation``. Default: True; images are never part of it.
    """

    observation: Sequence[str] | None = None
    action: str | Sequence[str] | None = None
    reward: str | None = None
    episode: str | None = None
    filter_key: str | None = None
    images: bool = False
    next_observation: bool = False
    concatenate: bool = True

    def __post_init__(self) -> None:
        """Raises for keys that are no text."""
        for name in ("observation", "action"):
            given = getattr(self, name)
            listed = [] if given is None else [given] if isinstance(given, str) else given
            if not isinstance(listed, Sequence) or not all(isinstance(key, str) for key in listed):
                raise TypeError(f"{name}={given!r} must be a key of the file, or a list of keys")
        for name in ("reward", "episode", "filter_key"):
            if not isinstance(getattr(self, name), (str, type(None))):
                raise TypeError(f"{name}={getattr(self, name)!r} must be a key of the file")
        for name in ("images", "next_observation", "concatenate"):
            check_flag(name, getattr(self, name))


@dataclass(frozen=True)
class Column:
    """An entry of a file.

    Args:
        shape: of one step.
        dtype: as the file has it.
        role: ``"observation"``, ``"action"``, ``"reward"``, ``"end"``, ``"index"`` or ``"other"``.
        image: whether it is an image, which is read only where it is asked for.
        readable: whether it is made of numbers.
    """

    shape: tuple[int, ...]
    dtype: str
    role: str = "other"
    image: bool = False
    readable: bool = True


@dataclass
class RawEpisode:
    """One episode as a reader found it.

    Args:
        name: in the file.
        columns: the keys that were asked for, each ``[T, *]``.
        reward: ``[T]``, if there is one.
        terminated: whether it ended by itself at its last step.
        following: observations after each step by key, ``[T, *]``, where they were asked for.
        timestamp: in s, ``[T]``, if there is one.
    """

    name: str
    columns: dict[str, np.ndarray]
    reward: np.ndarray | None = None
    terminated: bool = False
    following: dict[str, np.ndarray] = field(default_factory=dict)
    timestamp: np.ndarray | None = None


@dataclass(frozen=True)
class Provenance:
    """Where demonstrations come from, so that a rating can name rows of the source.

    Args:
        format: name of the format.
        path: the file or folder.
        observation: keys that were read as observation.
        action: keys that were read as action.
        layout: for a concatenated observation, each source key with its first column and the one after its last.
        left_out: keys that were not read.
        episodes: name in the source of each episode; ``episode`` in the data counts along it.
        facts: what else the source says of itself; JSON-able.
    """

    format: str
    path: str
    observation: tuple[str, ...]
    action: tuple[str, ...]
    layout: tuple[tuple[str, int, int], ...]
    left_out: tuple[str, ...]
    episodes: tuple[str, ...]
    facts: dict[str, Any]

    def to_json(self) -> dict[str, Any]:
        """The same as a dictionary that ``json`` can write."""
        return asdict(self)


class Demonstrations(NamedTuple):
    """What a reader gives.

    Args:
        data: flat ``[N]``, see :mod:`torchrl_tsallis.data.schema`; ``("info", "step")`` counts the steps of the
            source's episode, and ``("info", "timestamp")`` is its time in s, where there is one.
        source: where it comes from.
    """

    data: TensorDictBase
    source: Provenance


#: The formats by name, in the order in which they look at a path.
READERS: dict[str, type[Reader]] = {}


class Reader(ABC):
    """A format. One file with a subclass under :func:`register` adds one.

    Args:
        path: what :meth:`sniff` accepted.
        options: what to read.
    """

    name: ClassVar[str]
    #: Options beyond the keys of observation, action and reward that the format has.
    takes: ClassVar[frozenset[str]] = frozenset()
    #: Whether several entries called action are the columns of one.
    columns_of_one: ClassVar[bool] = False
    #: Whether the rows are pairs without episodes.
    pairs: bool = False

    def __init__(self, path: Path, options: Options) -> None:
        self.path = path
        self.options = options
        for option in ("episode", "filter_key"):
            if getattr(options, option) is not None and option not in self.takes:
                raise ValueError(f"{str(path)!r} is {self.name}, which has no {option}: leave it out")

    @classmethod
    @abstractmethod
    def sniff(cls, path: Path) -> bool:
        """Whether a path looks like the format; must not raise, and need not be sure that it can be read."""

    @abstractmethod
    def columns(self) -> dict[str, Column]:
        """The entries, by their keys in the file."""

    @abstractmethod
    def lengths(self) -> dict[str, int]:
        """Steps of each episode, by its name in the file, in the file's order."""

    @abstractmethod
    def episodes(self, keys: Sequence[str], reward: str | None, following: Sequence[str]) -> Iterator[RawEpisode]:
        """Reads the episodes' entries under the keys, the reward, and what follows each step."""

    def facts(self) -> dict[str, Any]:
        """What else the source says of itself."""
        return {}

    def labels(self, key: str) -> dict[str, str]:
        """What the file says of each episode under a key, as text, by the episode's name.

        Raises:
            KeyError: if there is no such key.
            ValueError: if it changes within an episode.
        """
        if key not in self.columns():
            raise KeyError(f"{str(self.path)!r} has no {key!r}, only {sorted(self.columns())}")
        return {
            episode.name: one_label(np.asarray(episode.columns[key]).reshape(-1).tolist(), key, episode.name, self.path)
            for episode in self.episodes([key], None, ())
        }

    def read(self) -> Demonstrations:
        """Reads the demonstrations."""
        from torchrl_tsallis.data.readers.assemble import assemble

        return assemble(self)


def one_label(values: Sequence[Any], key: str, episode: str, path: Path) -> str:
    """The one value that an episode has under a key, as text.

    Raises:
        ValueError: if there are several.

    Examples:
        >>> one_label([2.0, 2.0], "operator", "0", Path("table.csv"))
        '2'
    """
    found = sorted({str(int(x)) if isinstance(x, float) and x.is_integer() else str(x) for x in values})
    if len(found) != 1:
        raise ValueError(
            f"{key!r} of {str(path)!r} is {found[:3]} within episode {episode!r}: a label says one thing of an episode"
        )
    return found[0]


def register(reader: type[Reader]) -> type[Reader]:
    """Adds a format to those that are looked for; a class decorator."""
    READERS[reader.name] = reader
    return reader


def need(package: str, path: Path) -> Any:
    """Imports a package that only some formats need.

    Raises:
        ImportError: if it is not installed; the message names the extra.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise ImportError(
            f"{str(path)!r} needs {package.partition('.')[0]}: pip install 'torchrl-tsallis[formats]'"
        ) from error


@contextmanager
def reading(path: Path, *, fix: str = "copy it again, or record it again") -> Iterator[None]:
    """Turns whatever a storage library raises while it opens a file into one error that names the file.

    Raises:
        PermissionError: if the file may not be read.
        FileNotFoundError: if it is not there.
        ValueError: for all else: the file is truncated or none of its format.
    """
    try:
        yield
    except PermissionError as error:
        raise PermissionError(error.errno, f"no permission to read {str(path)!r}: chmod u+r, or copy it") from error
    except FileNotFoundError as error:
        raise FileNotFoundError(error.errno, f"{str(path)!r} is not there: {fix}") from error
    except MemoryError as error:
        raise MemoryError(
            f"{str(path)!r} does not fit into memory ({error}): choose fewer keys, or copy it again"
        ) from error
    except Exception as error:
        if isinstance(error, ValueError) and str(path) in str(error):
            raise
        reason = str(error).partition("\n")[0]
        raise ValueError(f"{str(path)!r} is truncated or broken ({reason}): {fix}") from error


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Puts the file's name before the message of a check of its rows."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{str(path)!r}: {error}") from error


def by_number(names: Sequence[str]) -> list[str]:
    """Sorts names by the number at their end: files sort ``episode_10`` before ``episode_2``.

    Examples:
        >>> by_number(["demo_10", "demo_9", "demo_0"])
        ['demo_0', 'demo_9', 'demo_10']
    """

    def key(name: str) -> tuple[str, int]:
        match = re.search(r"(\d+)$", name)
        return (name[: match.start()], int(match.group())) if match else (name, -1)

    return sorted(names, key=key)
