"""npz archives with D4RL's keys, or with those of ``imitation``."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from torchrl_tsallis.data.readers.base import Column, reading, register
from torchrl_tsallis.data.readers.table import ROLES, Table


@register
class NpzReader(Table):
    """Reads npz archives of arrays.

    Those with D4RL's keys end episodes by ``terminals`` and ``timeouts``, or by an episode number. Those of
    ``imitation`` have one observation more an episode, and ``indices`` where episodes are split. Pickled members are
    never read.
    """

    name = "npz"

    @classmethod
    def sniff(cls, path: Path) -> bool:
        """Whether the path is called ``.npz``."""
        return path.is_file() and path.suffix.lower() == ".npz"

    def _describe(self) -> dict[str, Column]:
        out = {}
        with reading(self.path), zipfile.ZipFile(self.path) as archive:
            broken = archive.testzip()
            if broken is not None:
                raise ValueError(f"{str(self.path)!r} is broken at its member {broken!r}: copy it again")
            for member in archive.namelist():
                if not member.endswith(".npy"):
                    continue
                key = member.removesuffix(".npy")
                with archive.open(member) as handle:
                    version = np.lib.format.read_magic(handle)
                    header = (
                        np.lib.format.read_array_header_1_0(handle)
                        if version == (1, 0)
                        else np.lib.format.read_array_header_2_0(handle)
                    )
                shape, _, dtype = header
                readable = dtype.kind in "fiub" and len(shape) > 0
                role = ROLES.get(key, "other") if shape else "other"
                image = dtype == np.uint8 and len(shape) == 4
                out[key] = Column(tuple(shape[1:]), "pickled" if dtype.hasobject else str(dtype), role, image, readable)
        self._arrays: dict[str, np.ndarray] = {}
        return out

    def _array(self, key: str) -> np.ndarray:
        if key not in self._arrays:
            with reading(self.path), np.load(self.path, allow_pickle=False) as archive:
                self._arrays[key] = archive[key]
        return self._arrays[key]

    def _size(self) -> int:
        wanted = self.options.action
        key = wanted if isinstance(wanted, str) and wanted in self._columns else self._named("action")
        if key is None:  # which is an error where it is read; what is there can still be described
            sizes = [len(self._array(name)) for name, column in self._columns.items() if column.readable]
            if not sizes:
                raise KeyError(f"nothing in {str(self.path)!r} is an array of numbers, only {sorted(self._columns)}")
            return max(sizes, key=sizes.count)
        return len(self._array(key))

    @property
    def _split(self) -> np.ndarray | None:
        """Where ``imitation`` splits its episodes, in rows of actions."""
        readable = "indices" in self._columns and self._columns["indices"].readable
        return np.asarray(self._array("indices")).reshape(-1) if readable and "acts" in self._columns else None

    def _find_cuts(self) -> list[tuple[str, int, int, bool]]:
        points = self._split
        if points is None:
            return super()._find_cuts()
        size = self._size()
        bounds = [0, *points.tolist(), size]
        lengths = np.diff(bounds)
        if (lengths < 0).any():
            raise ValueError(f"'indices' of {str(self.path)!r} do not rise up to {size}, the number of actions")
        ended = self._array("terminal").reshape(-1) if "terminal" in self._columns else np.zeros(len(lengths))
        if len(ended) != len(lengths):
            raise ValueError(f"'terminal' of {str(self.path)!r} has {len(ended)} entries for {len(lengths)} episodes")
        cuts = zip(range(len(lengths)), bounds, lengths.tolist(), ended, strict=False)
        return [(str(k), start, length, bool(end)) for k, start, length, end in cuts]

    def _rows(self, key: str) -> np.ndarray:
        return self._shifted(key, 0)

    def _shifted(self, key: str, by: int) -> np.ndarray:
        """Rows of pairs; of observations with one row more an episode without its last, or without its first."""
        array = self._array(key)
        if self._split is None or len(array) != self._size() + len(self._cuts):
            return super()._rows(key)
        parts = [array[start + k + by : start + k + by + n] for k, (_, start, n, _) in enumerate(self._cuts)]
        return np.concatenate(parts)

    def _following(self, key: str) -> np.ndarray:
        return super()._following(key) if self._split is None else self._shifted(key, 1)
