"""robomimic: one HDF5 file, ``data/demo_<i>`` with ``actions`` and ``obs/<key>``."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_tsallis.data.readers.base import Column, Options, RawEpisode, Reader, by_number, register
from torchrl_tsallis.data.readers.hdf5 import column, datasets, is_hdf5, open_hdf5, value

#: Filter keys that say nothing of who demonstrated.
_SPLIT = re.compile(r"(^|_)(train|valid)$")


@register
class RobomimicReader(Reader):
    """Reads robomimic's HDF5.

    An episode ends where its group ends: what ``dones`` means depends on how the file was made. Names of episodes are
    not contiguous and are sorted by number. ``filter_key`` chooses the episodes that ``mask/<filter_key>`` lists.
    """

    name = "robomimic"
    takes = frozenset({"filter_key"})

    @classmethod
    def sniff(cls, path: Path) -> bool:
        """Whether the path is a HDF5 file with a group ``data``, or one that cannot be opened."""
        if not is_hdf5(path):
            return False
        try:
            with open_hdf5(path) as file:
                return "data" in file and hasattr(file["data"], "keys")
        except (ImportError, ValueError, OSError):
            return True  # reading will say why

    def __init__(self, path: Path, options: Options) -> None:
        super().__init__(path, options)
        with open_hdf5(path) as file:
            self._names = self._chosen(file)
            if not self._names:
                raise ValueError(f"{str(path)!r} holds no episode under 'data': nothing was recorded")
            group = file["data"][self._names[0]]
            if "obs" not in group and options.observation is None:
                raise ValueError(
                    f"{str(path)!r} is a raw recording of states without observations: extract them by robomimic's "
                    "scripts/dataset_states_to_obs.py, or name keys by observation=[...], for instance 'states'"
                )
            self._columns = {key: column(item, _role(key)) for key, item in datasets(group).items()}
            self._lengths = {name: self._length(file["data"][name], name) for name in self._names}
            self._facts = self._read_facts(file)

    def _chosen(self, file: Any) -> list[str]:
        if "data" not in file or not hasattr(file["data"], "keys"):
            raise ValueError(f"{str(self.path)!r} has no group 'data', only {sorted(file)}: it is not robomimic's")
        names = by_number([name for name in file["data"] if hasattr(file["data"].get(name), "keys")])
        key = self.options.filter_key
        if key is None:
            return names
        masks = _masks(file)
        if key not in masks:
            raise KeyError(f"{str(self.path)!r} has no filter key {key!r}, only {sorted(masks)}")
        listed = set(masks[key])
        unknown = sorted(listed - set(names))
        if unknown:
            raise ValueError(
                f"filter key {key!r} of {str(self.path)!r} lists {len(unknown)} episodes that are not there, first "
                f"{unknown[:3]}: write the mask again"
            )
        return [name for name in names if name in listed]

    def _length(self, group: Any, name: str) -> int:
        if not hasattr(group.get("actions"), "shape"):
            raise KeyError(f"episode {name!r} of {str(self.path)!r} has no 'actions': it was not finished; remove it")
        return len(group["actions"])

    def _read_facts(self, file: Any) -> dict[str, Any]:
        facts: dict[str, Any] = {"masks": _masks(file)}
        try:
            facts["env"] = json.loads(file["data"].attrs.get("env_args", "{}")).get("env_name")
        except (ValueError, AttributeError, TypeError):
            facts["env"] = None  # free text of the recorder
        return facts

    def columns(self) -> dict[str, Column]:
        """The datasets of the first episode."""
        return self._columns

    def lengths(self) -> dict[str, int]:
        """Number of actions of each episode."""
        return self._lengths

    def facts(self) -> dict[str, Any]:
        """Masks and the environment's name."""
        return self._facts

    def labels(self, key: str) -> dict[str, str]:
        """Of a dataset; ``mask`` is the filter keys that list an episode, but for those of training and validation."""
        if key != "mask":
            return super().labels(key)
        lists = {name: listed for name, listed in self._facts["masks"].items() if not _SPLIT.search(name)}
        if not lists:
            raise KeyError(f"{str(self.path)!r} has no filter keys but those of training and validation")
        return {
            episode: "+".join(name for name, listed in lists.items() if episode in listed) or "none"
            for episode in self._names
        }

    def episodes(self, keys: Sequence[str], reward: str | None, following: Sequence[str]) -> Iterator[RawEpisode]:
        """Reads the groups one by one."""
        with open_hdf5(self.path) as file:
            for name in self._names:
                group = file["data"][name]
                read = {key: value(group, key, name, self.path) for key in keys}
                rewards = None if reward is None else value(group, reward, name, self.path)
                after = {}
                for key in following:
                    if f"next_{key}" not in group:
                        raise KeyError(
                            f"episode {name!r} of {str(self.path)!r} has no 'next_{key}': leave next_observation out"
                        )
                    after[key] = value(group, f"next_{key}", name, self.path)
                flag = group.get("dones")
                dones = np.asarray(flag[()]).reshape(-1) if hasattr(flag, "shape") else np.zeros(1)
                yield RawEpisode(name, read, rewards, bool(len(dones) and dones[-1]), after)


def _masks(file: Any) -> dict[str, list[str]]:
    """The episodes that each filter key lists."""
    group = file.get("mask", {})
    lists = {key: group.get(key) for key in group} if hasattr(group, "keys") else {}
    return {
        key: [x.decode(errors="replace") if isinstance(x, bytes) else str(x) for x in np.asarray(item[()]).reshape(-1)]
        for key, item in lists.items()
        if hasattr(item, "shape")
    }


def _role(key: str) -> str:
    if key.startswith("obs/"):
        return "observation"
    return {"actions": "action", "rewards": "reward", "dones": "end"}.get(key, "other")
