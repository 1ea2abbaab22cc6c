"""Minari: renumbered episodes, totals that fit, ``infos/rating`` in HDF5."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_tsallis.data.curators.base import Curator, Plan, register
from torchrl_tsallis.data.readers.base import need
from torchrl_tsallis.data.readers.hdf5 import open_hdf5
from torchrl_tsallis.data.readers.minari import data_folder


@register
class MinariCurator(Curator):
    """Writes a data set that minari loads: episodes count from 0, and each has its number as ``id``."""

    name = "minari"
    sequence = "Minari's episodes hold one observation more than actions, and a step left out would join two others"

    def __init__(self, plan: Plan) -> None:
        super().__init__(plan)
        self._folder = data_folder(plan.source)
        if self._folder is None:
            self.suffixes = (".hdf5", ".h5")

    def write(self, target: Path) -> None:
        """Writes the folder, or the single file that came in."""
        if self._folder is None:
            self._write_hdf5(self.plan.source, target)
            return
        data = target / "data"
        data.mkdir(parents=True)
        episodes = self.plan.reader.lengths()
        for item in sorted(self._folder.iterdir()):
            if item.name in ("metadata.json", "main_data.hdf5") or (item.is_dir() and item.name in episodes):
                continue
            (shutil.copytree if item.is_dir() else shutil.copyfile)(item, data / item.name)
        main = self._folder / "main_data.hdf5"
        if main.exists():
            self._write_hdf5(main, data / main.name)
        else:
            self._write_arrow(self._folder, data)
        self._write_metadata(self._folder / "metadata.json", data)

    def _write_hdf5(self, source: Path, target: Path) -> None:
        h5py = need("h5py", target)
        with open_hdf5(source) as file, h5py.File(target, "w", track_order=True) as out:
            out.attrs.update(file.attrs)
            for key in file:
                if not key.startswith("episode_"):
                    file.copy(key, out)
            for number, name in enumerate(self.plan.remaining()):
                file.copy(name, out, f"episode_{number}")
                group = out[f"episode_{number}"]
                group.attrs["id"] = number
                if "total_steps" not in group.attrs:
                    group.attrs["total_steps"] = self.plan.reader.lengths()[name]
                infos = group.require_group("infos")
                for key, values in (("rating", self.plan.rating), ("surprise", self.plan.surprise)):
                    if key in infos:  # of an earlier rating
                        del infos[key]
                    infos[key] = self.plan.steps(name, values).astype(np.float32)

    def _write_arrow(self, source: Path, target: Path) -> None:
        self.plan.notes.append(
            "the ratings are not in the copy: minari 0.5 cannot read entries of one number a step back from Arrow "
            "files; ratings.csv of the rating holds them"
        )
        for number, name in enumerate(self.plan.remaining()):
            shutil.copytree(source / name, target / str(number))
            described = target / str(number) / "metadata.json"
            if described.exists():
                described.write_text(json.dumps(json.loads(described.read_text()) | {"id": number}))

    def _write_metadata(self, source: Path, data: Path) -> None:
        if not source.exists():
            return
        described: dict[str, Any] = json.loads(source.read_text())
        lengths = self.plan.reader.lengths()
        remaining = self.plan.remaining()
        described |= {"total_episodes": len(remaining), "total_steps": sum(lengths[name] for name in remaining)}
        size = sum(file.stat().st_size for file in data.rglob("*") if file.is_file())
        described["dataset_size"] = round(size / 1e6, 1)
        (data / "metadata.json").write_text(json.dumps(described))

    def commands(self, out: Path) -> list[str]:
        """Loading the copy, and the same choice from the original."""
        if self._folder is None:
            return []
        numbers = sorted(int(name.rpartition("_")[2]) for name in self.plan.dropped)
        load = f"import minari; print(minari.MinariDataset({str(out / 'data')!r}).total_episodes)"
        same = f"minari.MinariDataset({str(self._folder)!r}).filter_episodes(lambda e: e.id not in {numbers})"
        return [f"python -c {shlex.quote(load)}", f"# the same choice from the original, in Python: {same}"]
