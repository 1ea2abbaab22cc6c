"""What a curated copy is, and the registry of the formats that can be copied."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np

from torchrl_tsallis.data.readers import Reader


@dataclass(frozen=True)
class Plan:
    """What to copy.

    Args:
        source: file or folder of the data; never written to.
        reader: the source, opened.
        names: of the rated episodes, ``[E]``, in the order of the source.
        lengths: their steps, ``[E]``.
        keep: whether an episode stays, ``[E]`` bool.
        keep_rows: whether a rated step stays, ``[N]`` bool.
        surprise: of each rated step, ``[N]``, in decades.
        rating: of each rated step, ``[N]``.
        name: of the subset, where the format names subsets.
        remove: whether dropped episodes are removed where the format could name a subset instead.
        notes: what the user should know of the copy; curators add to it.
    """

    source: Path
    reader: Reader
    names: tuple[str, ...]
    lengths: np.ndarray
    keep: np.ndarray
    keep_rows: np.ndarray
    surprise: np.ndarray
    rating: np.ndarray
    name: str = "curated"
    remove: bool = False
    notes: list[str] = field(default_factory=list)

    @property
    def dropped(self) -> set[str]:
        """Names of the episodes that go."""
        return {name for name, keep in zip(self.names, self.keep, strict=True) if not keep}

    @property
    def kept(self) -> list[str]:
        """Names of the rated episodes that stay, in order."""
        return [name for name, keep in zip(self.names, self.keep, strict=True) if keep]

    @property
    def by_episode(self) -> bool:
        """Whether whole episodes go, and no single steps."""
        return bool((self.keep_rows == np.repeat(self.keep, self.lengths)).all())

    def remaining(self) -> list[str]:
        """Names of the episodes of the copy: those that stay, and those that were not rated."""
        return [name for name in self.reader.lengths() if name not in self.dropped]

    def steps(self, name: str, values: np.ndarray) -> np.ndarray:
        """The part of an entry ``[N]`` that belongs to an episode; NaN for one that was not rated."""
        if name not in self.names:
            return np.full(self.reader.lengths()[name], np.nan)
        k = self.names.index(name)
        start = int(self.lengths[:k].sum())
        return values[start : start + int(self.lengths[k])]


#: The formats by the names of their readers.
CURATORS: dict[str, type[Curator]] = {}


class Curator(ABC):
    """Writes copies in a format. One file with a subclass under :func:`register` adds one.

    Args:
        plan: what to copy.
    """

    name: ClassVar[str]
    #: Why single steps cannot be dropped; None where they can.
    sequence: str | None = None
    #: Endings of a file's name, of which the copy's must be one; none for folders.
    suffixes: tuple[str, ...] = ()

    def __init__(self, plan: Plan) -> None:
        self.plan = plan

    @abstractmethod
    def write(self, target: Path) -> None:
        """Writes the copy at a path where nothing is; the caller moves it to its place."""

    def commands(self, out: Path) -> list[str]:
        """Commands of the format's own tools, which use the copy or make it again."""
        return []


def register(curator: type[Curator]) -> type[Curator]:
    """Adds a format to those that can be copied; a class decorator."""
    CURATORS[curator.name] = curator
    return curator
