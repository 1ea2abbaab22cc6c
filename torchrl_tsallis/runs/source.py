"""Demonstrations as a run takes them: vectors, finite, with episodes and the names of these."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_tsallis.data.episodes import Episodes, find_episodes, has_episodes
from torchrl_tsallis.data.readers import read_demonstrations
from torchrl_tsallis.data.readers.base import naming
from torchrl_tsallis.data.rows import pieces, row_bytes
from torchrl_tsallis.data.schema import check_rows
from torchrl_tsallis.data.storage import as_dtype

_KEYS = ("observation", "action")


@dataclass(frozen=True)
class Source:
    """Demonstrations and where they come from.

    Args:
        data: ``observation`` ``[N, O]``, ``action`` ``[N, A]``, and what else was read.
        path: file or folder; empty for data in memory.
        format: of the file; ``"memory"`` for data in memory.
        keys: read as observation and as action.
        names: of the episodes in the source.
        layout: of a concatenated observation, each key with its first dimension and the one after its last.
        chosen: ``episode`` and ``filter_key``, where they were given.
    """

    data: TensorDictBase
    path: str
    format: str
    keys: dict[str, list[str]]
    names: tuple[str, ...]
    layout: tuple[tuple[str, int, int], ...] = ()
    chosen: dict[str, str] = field(default_factory=dict)

    @property
    def dims(self) -> tuple[int, int]:
        """Dimensions of observation and action."""
        return self.data["observation"].shape[1], self.data["action"].shape[1]

    def episodes(self) -> Episodes:
        """Where the episodes are.

        Raises:
            ValueError: if nothing tells it.
        """
        return find_episodes(self.data, purpose="a rating by episodes", open_end=True)

    def to_json(self) -> dict[str, Any]:
        """What ``run.json`` says of the data."""
        episodes = len(self.episodes().starts) if has_episodes(self.data) else None
        return {
            "path": self.path,
            "format": self.format,
            "identity": identity(self.data),
            "keys": self.keys,
            "layout": [list(part) for part in self.layout],
            **self.chosen,
            "episodes": episodes,
            "steps": len(self.data),
        }


def identity(data: TensorDictBase) -> str:
    """SHA-256 of keys, shapes and content of observation, action and the episodes' lengths.

    Examples:
        >>> from tensordict import TensorDict
        >>> identity(TensorDict({"observation": torch.zeros(2, 1), "action": torch.zeros(2, 1)}, [2]))[:8]
        '36de8ba9'
    """
    digest = hashlib.sha256()
    entries: dict[str, Tensor] = {key: data[key] for key in _KEYS}
    if has_episodes(data):
        entries["episodes"] = find_episodes(data, open_end=True).lengths
    for key, value in entries.items():
        digest.update(f"{key} {list(value.shape)} {value.dtype};".encode())
        for part in pieces(len(value), row_bytes(value)):
            digest.update(value[part].contiguous().cpu().numpy().tobytes())
    return digest.hexdigest()


def load_source(
    path_or_data: str | os.PathLike[str] | TensorDictBase,
    *,
    obs: str | Sequence[str] | None = None,
    action: str | Sequence[str] | None = None,
    episode: str | None = None,
    format: str | None = None,
    filter_key: str | None = None,
) -> Source:
    """Reads and checks demonstrations.

    Args:
        path_or_data: what :func:`~torchrl_tsallis.data.readers.read_demonstrations` reads, or demonstrations ``[N]``
            in memory, of which the other arguments choose nothing.
        obs: keys of the observation in the file.
        action: key of the action in the file.
        episode: key of the episode's number in the file (npz, CSV).
        format: name of the format.
        filter_key: subset of the file's episodes.

    Returns:
        The data as float32.

    Raises:
        KeyError: if a key is missing.
        TypeError: if ``path_or_data`` is neither, or an entry is not made of numbers.
        ValueError: if rows are not finite, or observation or action are no vectors of numbers.
    """
    chosen = {"obs": obs, "action": action, "episode": episode, "format": format, "filter_key": filter_key}
    if isinstance(path_or_data, TensorDictBase):
        given = [name for name, value in chosen.items() if value is not None]
        if given:
            raise ValueError(f"{', '.join(given)} choose what is read of a file, the data is in memory: leave them out")
        check_rows(path_or_data, _KEYS)
        data = path_or_data if _single(path_or_data) else as_dtype(path_or_data, torch.float32)
        path, form, keys = "", "memory", {key: [key] for key in _KEYS}
        names: tuple[str, ...] | None = None
        layout: tuple[tuple[str, int, int], ...] = ()
    elif isinstance(path_or_data, (str, os.PathLike)):
        found = read_demonstrations(
            path_or_data, observation=obs, action=action, episode=episode, format=format, filter_key=filter_key
        )
        data, names, layout = found.data, found.source.episodes, tuple(found.source.layout)
        path, form = str(Path(found.source.path).resolve()), found.source.format
        keys = {"observation": list(found.source.observation), "action": list(found.source.action)}
    else:
        raise TypeError(f"demonstrations are a path or a TensorDict, got {type(path_or_data).__name__}")
    with naming(Path(path or "the demonstrations")):
        data = _vectors(data)
        count = len(find_episodes(data, open_end=True).starts) if has_episodes(data) else 0
    if names is None or len(names) != count:  # files without episodes, and data in memory
        names = tuple(map(str, range(count)))
    options = {name: value for name, value in (("episode", episode), ("filter_key", filter_key)) if value is not None}
    return Source(data, path, form, keys, names, layout, options)


def _single(data: TensorDictBase) -> bool:
    return all(isinstance(data[key], Tensor) and data[key].dtype == torch.float32 for key in _KEYS)


def _vectors(data: TensorDictBase) -> TensorDictBase:
    """The data with its observation as floating-point numbers.

    Raises:
        ValueError: if observation or action are no vectors.
    """
    for key in _KEYS:
        value = data[key]
        if isinstance(value, Tensor) and value.ndim == 2 and (value.is_floating_point() or key == "observation"):
            continue
        what = (
            f"{list(value.shape)} {value.dtype}"
            if isinstance(value, Tensor)
            else f"nested, of {sorted(map(str, value.keys()))}"
        )
        raise ValueError(
            f"{key!r} is {what}; needed are vectors of numbers [N, D]: choose the entries that are vectors (images and "
            "choices cannot be rated by this command; TsallisBCLoss takes any actor)"
        )
    if data["observation"].is_floating_point():
        return data
    return data.copy().set("observation", data["observation"].float())
