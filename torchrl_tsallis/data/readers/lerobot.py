"""LeRobot v3.0 and v2.1: a folder with ``meta/info.json`` and Parquet files."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_tsallis.data.readers.arrow import array_of, columns_of, is_binary, open_parquet, read_parquet
from torchrl_tsallis.data.readers.base import Column, Options, RawEpisode, Reader, reading, register
from torchrl_tsallis.data.readers.images import decode_images

_log = logging.getLogger(__name__)
_INDEX = ("timestamp", "frame_index", "episode_index", "index", "task_index")
_CONVERTERS = {
    "v2.0": "python -m lerobot.datasets.v21.convert_dataset_v20_to_v21 (LeRobot 0.3)",
    "v1": "lerobot/common/datasets/v2/convert_dataset_v1_to_v2.py (LeRobot 0.1), then by convert_dataset_v20_to_v21",
}


@register
class LeRobotReader(Reader):
    """Reads the Parquet files of a local LeRobot data set; never its videos.

    All files are read and sorted by episode and frame: files hold many episodes, and the pointers in the episode table
    of published data are often stale. Then they are compared with that table. There is no next observation and no
    termination. ``filter_key`` chooses the episodes of one of the splits in ``info.json``.
    """

    name = "lerobot"
    takes = frozenset({"filter_key"})

    @classmethod
    def sniff(cls, path: Path) -> bool:
        """Whether the path is a folder with ``meta/info.json``."""
        return (path / "meta" / "info.json").exists()

    def __init__(self, path: Path, options: Options) -> None:
        super().__init__(path, options)
        file = path / "meta" / "info.json"
        with reading(file):
            self._info = json.loads(file.read_text())
            if not isinstance(self._info, dict):
                raise ValueError(f"it is {type(self._info).__name__}, not an object")
        version = str(self._info.get("codebase_version", "none"))
        if not version.startswith(("v2.1", "v3.")):
            fix = next((f"convert it by {c}" for old, c in _CONVERTERS.items() if version.startswith(old)), None)
            fix = fix or "update torchrl-tsallis, or convert the data to v3.0 by LeRobot"
            raise ValueError(f"{str(path)!r} is LeRobot {version}; v2.1 and v3.x can be read: {fix}")
        self._features: dict[str, Any] = self._info.get("features") or {}
        if not isinstance(self._features, dict) or not all(isinstance(x, dict) for x in self._features.values()):
            raise ValueError(f"'features' of {str(file)!r} must be an object of objects: write the metadata again")
        self._files = sorted(path.glob("data/**/*.parquet"))
        if not self._files:
            raise FileNotFoundError(f"{str(path)!r} has no data/**/*.parquet: download the data beside the metadata")
        self._schema = open_parquet(self._files[0]).schema_arrow

    def columns(self) -> dict[str, Column]:
        """Columns of the first file, and videos that lie beside it."""
        out = {}
        for key, (shape, kind, readable) in columns_of(self._schema).items():
            described = self._features.get(key, {})
            image = is_binary(kind) or described.get("dtype") in ("image", "video")
            with reading(self.path / "meta" / "info.json"):
                named = [int(x) for x in described.get("shape", ())]
            shape = tuple(named) if image or (shape and -1 in shape) else shape
            out[key] = Column(shape, str(described.get("dtype", kind)), _role(key), image, readable)
        for key, described in self._features.items():
            if key not in out and described.get("dtype") == "video":
                out[key] = Column(tuple(described.get("shape", ())), "video", "observation", True, False)
        return out

    @cached_property
    def _order(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows by episode and frame, the episodes' numbers, and where each begins in that order."""
        keys = [key for key in ("episode_index", "frame_index", "index") if key in self._schema.names]
        if "episode_index" not in keys:
            raise KeyError(f"{str(self.path)!r} has no column 'episode_index': it is no LeRobot data")
        found = self._read(keys)
        episode = found["episode_index"].reshape(-1)
        tied = [found[key].reshape(-1) for key in ("frame_index", "index") if key in found]
        order = np.lexsort((*tied, episode))
        numbers, starts = np.unique(episode[order], return_index=True)
        if "frame_index" in found:
            frame = found["frame_index"].reshape(-1)[order]
            repeated = np.flatnonzero((np.diff(frame) == 0) & (np.diff(episode[order]) == 0))
            if len(repeated):
                raise ValueError(
                    f"episode {episode[order][repeated[0]]} of {str(self.path)!r} holds frame {frame[repeated[0]]} "
                    "twice: two files hold the same episode; remove one"
                )
        return order, numbers, starts

    def _read(self, keys: Sequence[str]) -> dict[str, Any]:
        """Columns of all files, one after the other."""
        parts: dict[str, list[Any]] = {key: [] for key in keys}
        for file in self._files:
            table = read_parquet(file, list(keys))
            for key in keys:
                found = array_of(table, key, file)
                parts[key].append(decode_images(found, key, file) if isinstance(found, list) else found)
        for key, arrays in parts.items():
            shapes = {part.shape[1:]: file for part, file in zip(arrays, self._files, strict=True) if len(part)}
            if len(shapes) > 1:
                where = {str(shape): file.name for shape, file in shapes.items()}
                raise ValueError(f"{key!r} of {str(self.path)!r} differs in shape between files, {where}: leave it out")
            if not shapes:
                raise ValueError(f"{str(self.path)!r} holds no row: nothing was recorded")
        return {key: np.concatenate([part for part in arrays if len(part)]) for key, arrays in parts.items()}

    @cached_property
    def _chosen(self) -> list[int]:
        """Numbers of the episodes of the split."""
        _, numbers, _ = self._order
        self._compare()
        key = self.options.filter_key
        if key is None:
            return [int(number) for number in numbers]
        splits = self._info.get("splits") or {}
        if key not in splits:
            raise KeyError(f"{str(self.path)!r} has no split {key!r}, only {sorted(splits)}")
        try:
            first, _, last = str(splits[key]).partition(":")
            chosen = range(int(first or 0), int(last or numbers.max() + 1))
        except ValueError as error:
            raise ValueError(
                f"split {key!r} of {str(self.path / 'meta' / 'info.json')!r} is {splits[key]!r}, needed is 'from:to'"
            ) from error
        return [int(number) for number in numbers if int(number) in chosen]

    def _all_lengths(self) -> dict[int, int]:
        order, numbers, starts = self._order
        return dict(zip(numbers.tolist(), np.diff([*starts, len(order)]).tolist(), strict=True))

    def lengths(self) -> dict[str, int]:
        """Frames of each episode."""
        found = self._all_lengths()
        return {str(number): found[number] for number in self._chosen}

    @cached_property
    def _table(self) -> dict[int, dict[str, int]]:
        """The episode table: length and, in v3, pointers."""
        lines = self.path / "meta" / "episodes.jsonl"
        if lines.exists():
            with reading(lines):
                rows = [json.loads(line) for line in lines.read_text().splitlines() if line.strip()]
                return {int(row["episode_index"]): {"length": int(row["length"])} for row in rows}
        out: dict[int, dict[str, int]] = {}
        for file in sorted(self.path.glob("meta/episodes/**/*.parquet")):
            wanted = ["episode_index", "length"]
            pointers = ["dataset_from_index", "dataset_to_index"]
            there = open_parquet(file).schema_arrow.names
            table = read_parquet(file, [*wanted, *(key for key in pointers if key in there)])
            for row in table.to_pylist():
                out[row.pop("episode_index")] = row
        return out

    @cached_property
    def _stale(self) -> list[int]:
        """Episodes whose pointers in the table are not where their rows are."""
        stale, start = [], 0
        for number, length in self._all_lengths().items():
            row = self._table.get(number, {})
            wanted = row.get("dataset_from_index", start), row.get("dataset_to_index", start + length)
            if wanted != (start, start + length):
                stale.append(number)
            start += length
        return stale

    def _compare(self) -> None:
        """Raises where rows and episode table do not fit; stale pointers are only said."""
        found = self._all_lengths()
        if self._table:
            for number in sorted(found.keys() | self._table.keys()):
                said, there = self._table.get(number, {}).get("length"), found.get(number)
                if not said and not there:
                    raise ValueError(
                        f"episode {number} of {str(self.path)!r} is empty: delete it by LeRobot's own tools"
                    )
                if said != there:
                    raise ValueError(
                        f"episode {number} of {str(self.path)!r} has {there or 'no'} rows, its table under meta says "
                        f"{said or 'none'}: download the missing files, or write the metadata again"
                    )
        if self._stale:
            _log.warning(
                "%s: the episode table points to other rows for %d episodes, first %s; the rows' episode_index counts",
                self.path,
                len(self._stale),
                self._stale[:5],
            )

    def episodes(self, keys: Sequence[str], reward: str | None, following: Sequence[str]) -> Iterator[RawEpisode]:
        """Reads the columns of all files, and cuts them into episodes."""
        if following:
            raise ValueError(f"{str(self.path)!r} is LeRobot, which has no next observations: leave them out")
        order, numbers, starts = self._order
        chosen = set(self._chosen)
        times = ["timestamp"] if "timestamp" in self._schema.names else []
        read = self._read(list(dict.fromkeys([*keys, *times, *([reward] if reward else [])])))
        stops = [*starts[1:], len(order)]
        for number, start, stop in zip(numbers.tolist(), starts, stops, strict=True):
            if number in chosen:
                rows = order[start:stop]
                yield RawEpisode(
                    str(number),
                    {key: read[key][rows] for key in keys},
                    None if reward is None else read[reward][rows],
                    timestamp=read["timestamp"][rows] if times else None,
                )

    def facts(self) -> dict[str, Any]:
        """Version, robot, rate, splits, names of dimensions, and episodes with stale pointers."""
        kept = {key: self._info.get(key) for key in ("codebase_version", "robot_type", "fps", "splits")}
        names = {key: described.get("names") for key, described in self._features.items() if _role(key) != "other"}
        return kept | {"names": names, "stale_pointers": self._stale}


def _role(key: str) -> str:
    if key in _INDEX:
        return "index"
    if key.split(".")[0] in ("observation", "observations", "state", "states", "obs"):
        return "observation"
    if key in ("action", "actions"):
        return "action"
    return {"next.reward": "reward", "reward": "reward", "next.done": "end"}.get(key, "other")
