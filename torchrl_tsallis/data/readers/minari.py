"""Minari: a folder with ``data/metadata.json`` and HDF5, Arrow or Parquet files."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_tsallis.data.readers.arrow import array_of, columns_of, is_binary, open_arrow
from torchrl_tsallis.data.readers.base import Column, Options, RawEpisode, Reader, by_number, reading, register
from torchrl_tsallis.data.readers.hdf5 import column, datasets, is_hdf5, open_hdf5, value
from torchrl_tsallis.data.readers.images import decode_images

_ROLES = {"actions": "action", "rewards": "reward", "terminations": "end", "truncations": "end"}


def _role(key: str) -> str:
    root = key.partition("/")[0]
    return "observation" if root == "observations" else _ROLES.get(root, "other")


def data_folder(path: Path) -> Path | None:
    """The folder ``data`` of a data set that is given by its own folder, by ``data``, or by the HDF5 file in it."""
    folder = path.parent if path.name == "main_data.hdf5" else path
    for candidate in (folder / "data", folder):
        if (candidate / "main_data.hdf5").exists():
            return candidate
        metadata = candidate / "metadata.json"
        if metadata.is_file():
            try:
                described = json.loads(metadata.read_text())
            except (OSError, ValueError):
                continue
            if "data_format" in described or "total_episodes" in described:
                return candidate
    return None


@register
class MinariReader(Reader):
    """Reads Minari's data sets.

    Observations have one row more than actions, which is dropped (and read as next observations where those are asked
    for). Episodes are sorted by number, not by name; one that ends with neither flag is a truncated one. Arrow rows
    are padded to the observations' length; the padding is dropped.
    """

    name = "minari"

    @classmethod
    def sniff(cls, path: Path) -> bool:
        """Whether the path is a data set's folder, its ``data``, or a HDF5 file with groups ``episode_<i>``."""
        if data_folder(path) is not None:
            return True
        if not is_hdf5(path):
            return False
        try:
            with open_hdf5(path) as file:
                return any(name.startswith("episode_") for name in file)
        except (ImportError, ValueError, OSError):
            return False

    def __init__(self, path: Path, options: Options) -> None:
        super().__init__(path, options)
        folder = data_folder(path)
        self._metadata = self._read_metadata(folder)
        if folder is None or (folder / "main_data.hdf5").exists():
            self._source: _Hdf5 | _Arrow = _Hdf5(path if folder is None else folder / "main_data.hdf5")
        else:
            self._source = _Arrow(folder)
        expected = self._metadata.get("total_episodes")
        if not self._source.lengths:
            raise ValueError(f"{str(path)!r} holds no episode: nothing was recorded")
        if isinstance(expected, int) and expected != len(self._source.lengths):
            raise ValueError(
                f"{str(path)!r} holds {len(self._source.lengths)} episodes, its metadata.json says {expected}: copy it "
                "again, or correct total_episodes"
            )

    def _read_metadata(self, folder: Path | None) -> dict[str, Any]:
        file = None if folder is None else folder / "metadata.json"
        if file is None or not file.exists():
            return {}
        with reading(file):
            found = json.loads(file.read_text())
            return found if isinstance(found, dict) else {}

    def columns(self) -> dict[str, Column]:
        """The entries of the first episode."""
        return self._source.columns

    def lengths(self) -> dict[str, int]:
        """Number of actions of each episode."""
        return self._source.lengths

    def facts(self) -> dict[str, Any]:
        """Names and the action's space; observation spaces of images are as large as the images."""
        kept = ("dataset_id", "env_spec", "algorithm_name", "minari_version", "action_space", "data_format")
        return {key: self._metadata[key] for key in kept if key in self._metadata}

    def episodes(self, keys: Sequence[str], reward: str | None, following: Sequence[str]) -> Iterator[RawEpisode]:
        """Reads the episodes one by one."""
        for name, size in self.lengths().items():
            if not size:
                raise ValueError(f"episode {name!r} of {str(self.path)!r} is empty: delete it by minari's own tools")
            wanted = dict.fromkeys([*keys, *following, "terminations", "truncations", *([reward] if reward else [])])
            read = self._source.read(name, list(wanted))
            ends = [np.asarray(read[key]).reshape(-1)[:size].astype(bool) for key in ("terminations", "truncations")]
            early = np.flatnonzero((ends[0] | ends[1])[:-1])
            if len(early):
                raise ValueError(
                    f"episode {name!r} of {str(self.path)!r} ends at step {early[0]} by its flags, but has {size} "
                    "steps: split it there, or correct the flags"
                )
            after = {}
            for key in following:
                if len(read[key]) != size + 1:
                    raise ValueError(f"{key!r} of episode {name!r} has no row after the last step: {str(self.path)!r}")
                after[key] = read[key][1:]
            columns = {key: self._steps(read[key], size, key, name) for key in keys}
            rewards = None if reward is None else np.asarray(read[reward])[:size]
            yield RawEpisode(name, columns, rewards, bool(ends[0][-1]), after)

    def _steps(self, rows: np.ndarray, size: int, key: str, name: str) -> np.ndarray:
        if len(rows) not in (size, size + 1):
            raise ValueError(
                f"{key!r} of episode {name!r} of {str(self.path)!r} has {len(rows)} rows, needed are {size} or "
                f"{size + 1}: the episode was cut while it was written; delete it"
            )
        return rows[:size]


class _Hdf5:
    """``main_data.hdf5``: groups ``episode_<i>``."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.lengths: dict[str, int] = {}
        self.columns: dict[str, Column] = {}
        with open_hdf5(path) as file:
            names = by_number([name for name in file if name.startswith("episode_")])
            for name in names:
                actions = file[name].get("actions")
                if actions is None:
                    raise KeyError(
                        f"episode {name!r} of {str(path)!r} has no 'actions': it was not finished; delete it"
                    )
                leaf = next(iter(datasets(actions).values())) if hasattr(actions, "keys") else actions
                self.lengths[name] = len(leaf)
            if names:
                self.columns = {
                    key: column(item, _role(key), _encoded(key, item)) for key, item in datasets(file[names[0]]).items()
                }

    def read(self, name: str, keys: list[str]) -> dict[str, np.ndarray]:
        with open_hdf5(self.path) as file:
            out = {key: value(file[name], key, name, self.path) for key in keys}
        for key, rows in out.items():
            if key in self.columns and self.columns[key].image and rows.ndim <= 2:
                out[key] = decode_images([np.asarray(row, np.uint8).tobytes() for row in rows], key, self.path)
        return out


def _encoded(key: str, dataset: Any) -> bool:
    """Whether a dataset holds JPEG bytes: of several lengths, or of one by chance."""
    if not key.startswith("observations") or not len(dataset):
        return False
    if dataset.dtype.kind == "O":
        first = dataset[0]
        return isinstance(first, np.ndarray) and first.dtype == np.uint8
    return dataset.dtype == np.uint8 and dataset.ndim == 2 and bytes(dataset[0][:2]) == b"\xff\xd8"


class _Arrow:
    """Folders ``<i>`` with ``part-0.arrow`` or ``part-0.parquet``, a row a step and one more."""

    def __init__(self, folder: Path) -> None:
        self.path = folder
        names = by_number([x.name for x in folder.iterdir() if x.is_dir() and x.name.isdigit()])
        self.files = {
            name: sorted((folder / name).glob("*.arrow")) or sorted((folder / name).glob("*.parquet")) for name in names
        }
        self.lengths: dict[str, int] = {}
        self.columns: dict[str, Column] = {}
        for name, files in self.files.items():
            if not files:
                raise FileNotFoundError(
                    f"episode {name!r} of {str(folder)!r} has no .arrow or .parquet file: copy it again"
                )
            described = folder / name / "metadata.json"
            table = open_arrow(files[0])
            steps = sum(open_arrow(file).num_rows for file in files) - 1
            if described.exists():
                with reading(described):
                    steps = int(json.loads(described.read_text()).get("total_steps", steps))
            self.lengths[name] = steps
            if not self.columns:
                self.columns = {
                    key: Column(shape, str(kind), _role(key), is_binary(kind) and _role(key) == "observation", readable)
                    for key, (shape, kind, readable) in columns_of(table).items()
                }

    def read(self, name: str, keys: list[str]) -> dict[str, np.ndarray]:
        size = self.lengths[name]
        out = {}
        for key in keys:
            rows = []
            for file in self.files[name]:
                found = array_of(open_arrow(file), key, file, name)
                rows.append(decode_images(found, key, file) if isinstance(found, list) else found)
            whole = np.concatenate(rows)
            out[key] = whole if key.startswith("observations") else whole[:size]
        return out
