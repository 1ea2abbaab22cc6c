"""TED tensordicts: memory-mapped folders, folders of ``ReplayBuffer.dumps``, and this package's safetensors files."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_tsallis.data.demonstrations import load_demonstrations
from torchrl_tsallis.data.episodes import find_episodes, has_episodes
from torchrl_tsallis.data.readers.assemble import choose, concatenate_observations
from torchrl_tsallis.data.readers.base import (
    Column,
    Demonstrations,
    Options,
    Provenance,
    RawEpisode,
    Reader,
    naming,
    reading,
    register,
)

_TORCH = (".pt", ".pth", ".ckpt", ".pkl", ".pickle")


def _folder(path: Path) -> Path | None:
    """The folder of the memory map: the path, or the storage of a dumped buffer in it."""
    for folder in (path / "storage", path):
        if (folder / "meta.json").is_file():
            return folder
    return None


def load_rows(path: Path) -> TensorDictBase:
    """Opens the rows without reading them; nothing is unpickled.

    Raises:
        ValueError: if it is broken, or only unpickling would read it.
    """
    if path.suffix.lower() in _TORCH:
        raise ValueError(
            f"{str(path)!r} is a pickle, and loading one runs the code in it: where you trust it, write it anew by "
            f"torch.load({path.name!r}, weights_only=False).memmap('folder'), and read the folder"
        )
    if path.is_file():
        return load_demonstrations(path)[0]
    folder = _folder(path)
    if folder is None:
        raise ValueError(f"{str(path)!r} has no meta.json: it is no memory-mapped tensordict")
    with reading(folder / "meta.json"):
        described = json.loads((folder / "meta.json").read_text())
        _check_files(folder, described)
    with reading(path):
        data = TensorDict.load_memmap(folder, allow_pickle=False)
    written = folder / "storage_metadata.json"
    if written.is_file():  # a buffer's folder has room for its capacity, of which so much is filled
        with reading(written):
            data = data[: int(json.loads(written.read_text())["len"])]
    return data


def _check_files(folder: Path, described: dict[str, Any]) -> None:
    """Raises where a tensor's file is missing or too short: mapping it would read past its end."""
    for key, entry in described.items():
        if not isinstance(entry, dict):
            continue
        if (folder / key / "meta.json").is_file():
            _check_files(folder / key, json.loads((folder / key / "meta.json").read_text()))
        elif "shape" in entry and "dtype" in entry:
            file = folder / f"{key}.memmap"
            dtype = getattr(torch, str(entry["dtype"]).removeprefix("torch."))
            wanted = torch.Size(entry["shape"]).numel() * torch.empty(0, dtype=dtype).element_size()
            size = file.stat().st_size
            if size < wanted:
                raise ValueError(f"{str(file)!r} is truncated: it has {size} of {wanted} bytes; copy it again")


@register
class TedReader(Reader):
    """Reads tensordicts; those on disk stay there (keys are nested ones with dots: ``observation.state``)."""

    name = "ted"

    @classmethod
    def sniff(cls, path: Path) -> bool:
        """Whether the path is a folder of a memory map, a safetensors file, or a pickle of torch."""
        if path.is_dir():
            return _folder(path) is not None
        return path.suffix.lower() in (".safetensors", *_TORCH)

    def __init__(self, path: Path, options: Options) -> None:
        super().__init__(path, options)
        self._data = load_rows(path)
        if self._data.ndim == 2:  # episodes of one length
            count, length = self._data.shape
            self._data = self._data.reshape(-1)
            if not has_episodes(self._data):
                self._data.set("episode", torch.arange(count).repeat_interleave(length))
        if self._data.ndim != 1:
            raise ValueError(f"{str(path)!r} has the batch size {list(self._data.shape)}, needed is [N]: save it flat")
        self._keys: dict[str, NestedKey] = {
            key if isinstance(key, str) else ".".join(key): key for key in self._data.keys(True, True)
        }
        if not len(self._data) or not self._keys:
            raise ValueError(f"{str(path)!r} holds no row: nothing was recorded")
        self.pairs = not has_episodes(self._data)

    def columns(self) -> dict[str, Column]:
        """The tensors, by their nested keys with dots."""
        out = {}
        for name, key in self._keys.items():
            value = self._data.get(key)
            tensor = isinstance(value, Tensor)
            image = tensor and value.dtype == torch.uint8 and value.ndim == 4
            dtype = str(value.dtype).removeprefix("torch.") if tensor else type(value).__name__
            out[name] = Column(tuple(value.shape[1:]), dtype, _role(name), image, tensor)
        return out

    def lengths(self) -> dict[str, int]:
        """Rows of each episode."""
        if self.pairs:
            return {"0": len(self._data)}
        with naming(self.path):
            found = find_episodes(self._data, open_end=True)
        number = self._data.get("episode", self._data.get(("info", "episode"), None))
        names = range(len(found.starts)) if number is None else number.reshape(-1)[found.starts].tolist()
        return dict(zip(map(str, names), found.lengths.tolist(), strict=True))

    def episodes(self, keys: Sequence[str], reward: str | None, following: Sequence[str]) -> Iterator[RawEpisode]:
        """Gives the rows of each episode."""
        start = 0
        for name, size in self.lengths().items():
            rows = self._data[start : start + size]
            start += size
            yield RawEpisode(name, {key: rows[self._keys[key]].numpy() for key in keys})

    def read(self) -> Demonstrations:
        """Gives the tensordict with the chosen observation; where it is memory-mapped, it stays so."""
        options, columns = self.options, self.columns()
        data = self._data.copy()
        chosen = [key for key, column in columns.items() if column.role == "observation"]
        layout: tuple[tuple[str, int, int], ...] = ()
        if options.observation is not None:
            wanted = [options.observation] if isinstance(options.observation, str) else list(options.observation)
            chosen = choose(columns, wanted, "observation", self.path)
            parts = {name.rpartition(".")[2]: data[self._keys[name]] for name in chosen}
            data.set("observation", next(iter(parts.values())) if len(parts) == 1 else TensorDict(parts, data.shape))
        elif not options.images and isinstance(data.get("observation", None), TensorDictBase):
            images = [key for key in chosen if columns[key].image]
            data = data.exclude(*(self._keys[key] for key in images))
            chosen = [key for key in chosen if key not in images]
        action = "action" if options.action is None else options.action
        actions = choose(columns, [action] if isinstance(action, str) else list(action), "action", self.path)
        if actions != ["action"]:
            if len(actions) != 1:
                raise ValueError(f"{str(self.path)!r}: name one action, got {actions}")
            data.set("action", data[self._keys[actions[0]]])
        if not chosen:
            raise KeyError(f"{str(self.path)!r} has no 'observation', only {sorted(columns)}: name it")
        if options.reward is not None:
            data.set(("next", "reward"), data[self._keys[choose(columns, [options.reward], "reward", self.path)[0]]])
        observation = data["observation"]
        if (
            isinstance(observation, TensorDictBase)
            and options.concatenate
            and all(value.ndim <= 2 for value in observation.values(True, True))
        ):
            data, layout = concatenate_observations(data, [name.rpartition(".")[2] for name in chosen])
        lengths = self.lengths()
        if not self.pairs:
            sizes = torch.tensor(list(lengths.values()))
            first = torch.zeros(len(data), dtype=torch.int64)
            starts = sizes.cumsum(0) - sizes
            data.set(("info", "step"), torch.arange(len(data)) - starts.repeat_interleave(sizes))
            if data.get("episode", None) is None:
                first[starts[1:]] = 1
                data.set("episode", first.cumsum(0))
        left_out = tuple(key for key, column in columns.items() if column.role == "observation" and key not in chosen)
        source = Provenance(
            self.name, str(self.path), tuple(chosen), tuple(actions), layout, left_out, tuple(lengths), {}
        )
        return Demonstrations(data, source)


def _role(name: str) -> str:
    root = name.partition(".")[0]
    if root in ("observation", "action"):
        return root
    if name == "next.reward":
        return "reward"
    if name in ("next.done", "next.terminated", "next.truncated", "is_init"):
        return "end"
    return "index" if name in ("episode", "index") else "other"
