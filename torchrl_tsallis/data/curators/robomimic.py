"""robomimic: a filter key in a copy of the file, or a file without the dropped episodes."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_tsallis.data.curators.base import Curator, register
from torchrl_tsallis.data.readers.base import need
from torchrl_tsallis.data.readers.hdf5 import open_hdf5


def _texts(dataset: Any) -> list[str]:
    entries = np.asarray(dataset[()]).reshape(-1)
    return [x.decode(errors="replace") if isinstance(x, bytes) else str(x) for x in entries]


@register
class RobomimicCurator(Curator):
    """Adds ``mask/<name>`` with the episodes that stay; where they are removed, masks and ``total`` are made to fit."""

    name = "robomimic"
    sequence = "robomimic trains on windows of steps, and a window over a gap would join steps that never followed"
    suffixes = (".hdf5", ".h5")

    def write(self, target: Path) -> None:
        """Writes the file."""
        h5py = need("h5py", target)
        with open_hdf5(self.plan.source) as file:
            if self.plan.name in file.get("mask", {}):
                raise ValueError(
                    f"{str(self.plan.source)!r} has a filter key {self.plan.name!r} already: choose another name"
                )
            if self.plan.remove:
                with h5py.File(target, "w") as out:
                    self._copy_remaining(file, out)
        if not self.plan.remove:
            shutil.copyfile(self.plan.source, target)
        with h5py.File(target, "r+") as out:
            out[f"mask/{self.plan.name}"] = np.array([name.encode() for name in self.plan.kept])

    def _copy_remaining(self, file: Any, out: Any) -> None:
        out.attrs.update(file.attrs)
        for key in file:
            if key not in ("data", "mask"):
                file.copy(key, out)
        data = out.create_group("data")
        data.attrs.update(file["data"].attrs)
        for name in file["data"]:
            if name not in self.plan.dropped:
                file["data"].copy(name, data)
        lengths = [len(demo["actions"]) for demo in data.values() if "actions" in demo]
        data.attrs["total"] = sum(lengths)
        for key in file.get("mask", {}):
            stay = [name for name in _texts(file["mask"][key]) if name not in self.plan.dropped]
            if stay:
                out[f"mask/{key}"] = np.array([name.encode() for name in stay])
            else:
                self.plan.notes.append(f"no episode of the filter key {key!r} stays: the copy has no such key")

    def commands(self, out: Path) -> list[str]:
        """Training with the filter key, and a look at it."""
        place, name = shlex.quote(str(out)), shlex.quote(self.plan.name)
        return [
            f"python -m robomimic.scripts.get_dataset_info --dataset {place} --filter_key {name}",
            f"# in robomimic's config: train.hdf5_filter_key = {self.plan.name!r}, train.data = {str(out)!r}",
        ]
