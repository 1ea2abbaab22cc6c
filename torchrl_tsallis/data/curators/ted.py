"""TED tensordicts: memory-mapped folders, folders of ``ReplayBuffer.dumps``, safetensors files."""

from __future__ import annotations

import tempfile
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torchrl.data import LazyMemmapStorage, TensorDictReplayBuffer

from torchrl_tsallis.data.curators.base import Curator, Plan, register
from torchrl_tsallis.data.curators.gaps import bounds
from torchrl_tsallis.data.curators.place import check_room
from torchrl_tsallis.data.demonstrations import load_demonstrations, save_demonstrations
from torchrl_tsallis.data.readers.ted import load_rows
from torchrl_tsallis.data.rows import row_bytes

_ROWS = 65536  # copied at once


@register
class TedCurator(Curator):
    """Writes the rows with ``("info", "rating")`` and ``("info", "surprise")``; numbers of episodes stay."""

    name = "ted"

    def __init__(self, plan: Plan) -> None:
        super().__init__(plan)
        if plan.source.is_file():
            self.suffixes = (".safetensors",)

    def write(self, target: Path) -> None:
        """Writes the file or folder."""
        source = self.plan.source
        data = load_rows(source)
        if data.ndim == 2:
            count, length = data.shape
            data = data.reshape(-1)
            if data.get("episode", None) is None:
                data.set("episode", torch.arange(count).repeat_interleave(length))
            self.plan.notes.append("the copy is flat, [N], with the number of its episode in every row")
        rows = torch.from_numpy(self.plan.keep_rows.nonzero()[0])
        if source.is_dir():
            check_room(target, len(rows) * (row_bytes(data) + 8))
        if source.is_file():
            _, metadata = load_demonstrations(source)
            save_demonstrations(target, self._take(data, rows), metadata)
        elif (source / "storage" / "meta.json").is_file():
            with tempfile.TemporaryDirectory(dir=target.parent, prefix=f"{target.name}-") as scratch:
                buffer = TensorDictReplayBuffer(storage=LazyMemmapStorage(len(rows), scratch_dir=scratch))
                for part in rows.split(_ROWS):
                    buffer.extend(self._take(data, part))
                buffer.dumps(target)
            self.plan.notes.append(f"the capacity of the copied buffer is {len(rows)}, its number of rows")
        else:
            copy = self._take(data, rows[:1]).expand(len(rows)).memmap_like(str(target))
            for start in range(0, len(rows), _ROWS):
                copy[start : start + _ROWS] = self._take(data, rows[start : start + _ROWS])

    def _take(self, data: TensorDictBase, rows: torch.Tensor) -> TensorDictBase:
        """Some rows and their ratings; where steps were dropped, the last one that stays ends its episode."""
        out = data[rows].clone()
        for key, values in (("rating", self.plan.rating), ("surprise", self.plan.surprise)):
            out.set(("info", key), torch.from_numpy(values[rows.numpy()].astype("float32")))
        if self.plan.by_episode:
            return out
        first, last = (torch.from_numpy(x[rows.numpy()]) for x in bounds(self.plan.lengths, self.plan.keep_rows))
        flags = {name: out.get(("next", name), None) for name in ("terminated", "truncated", "done")}
        ended = torch.zeros(len(rows), dtype=torch.bool)
        for name in ("terminated", "truncated"):
            if flags[name] is not None:
                ended |= flags[name].reshape(-1).bool()
        for name in ("truncated", "done"):
            if flags[name] is not None:
                new = last if name == "done" else last & ~ended
                flags[name][new] = True
        if flags["terminated"] is not None and flags["truncated"] is None and flags["done"] is None:
            flags["terminated"][last] = True
        if out.get("is_init", None) is not None:
            out["is_init"][first] = True
        return out
