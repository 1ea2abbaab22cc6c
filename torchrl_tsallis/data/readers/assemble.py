"""From a reader's episodes to the schema: keys are chosen, shapes compared, vectors put side by side."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_tsallis.data.readers.base import Column, Demonstrations, Provenance, RawEpisode, Reader
from torchrl_tsallis.data.rows import map_rows


def choose(columns: dict[str, Column], wanted: Iterable[str], what: str, path: object) -> list[str]:
    """The keys that patterns name, in the order of the patterns.

    Raises:
        KeyError: if a pattern names none; the message lists the keys.
        TypeError: if what it names is not made of numbers.
    """
    found: list[str] = []
    for pattern in wanted:
        matches = [pattern] if pattern in columns else fnmatch.filter(columns, pattern)
        if not matches:
            raise KeyError(f"{str(path)!r} has no {pattern!r} for the {what}, only {sorted(columns)}")
        found += [key for key in matches if key not in found]
    for key in found:
        if not columns[key].readable:
            raise TypeError(
                f"{key!r} of {str(path)!r} is {columns[key].dtype}, not numbers, and is never unpickled: choose another"
            )
    return found


def _keys(reader: Reader) -> tuple[list[str], list[str], str | None]:
    """Keys of observation, action and reward, as the options or the format name them."""
    columns, options, path = reader.columns(), reader.options, reader.path
    roles = {
        role: [key for key, column in columns.items() if column.role == role and column.readable]
        for role in ("observation", "action", "reward")
    }
    if options.observation is not None:
        wanted = [options.observation] if isinstance(options.observation, str) else list(options.observation)
        observation = choose(columns, wanted, "observation", path)
    else:
        observation = [key for key in roles["observation"] if options.images or not columns[key].image]
    if not observation:
        raise KeyError(
            f"nothing in {str(path)!r} is called an observation"
            + (" but images, which images=True reads" if roles["observation"] else "")
            + f": name its keys by observation=[...], one or more of {sorted(columns)}"
        )
    if options.action is not None:
        action = [options.action] if isinstance(options.action, str) else list(options.action)
        action = choose(columns, action, "action", path)
        if not action:
            raise KeyError(f"action=[] names no entry of {str(path)!r}: name one or more of {sorted(columns)}")
    else:
        action = roles["action"]
        if not action or (len(action) > 1 and not reader.columns_of_one):
            raise KeyError(
                f"{str(path)!r} has {len(action) or 'no'} entries called action: name one by action=..., "
                f"of {sorted(columns)}"
            )
    if options.reward is not None:
        return observation, action, choose(columns, [options.reward], "reward", path)[0]
    return observation, action, roles["reward"][0] if roles["reward"] else None


def _tensor(parts: list[np.ndarray], key: str, names: list[str], path: object) -> Tensor:
    """Joins an entry of all episodes, after comparing their shapes and dtypes."""
    first = parts[0]
    for part, name in zip(parts, names, strict=True):
        if part.shape[1:] != first.shape[1:]:
            raise ValueError(
                f"{key!r} of {str(path)!r} has rows of shape {list(part.shape[1:])} in episode {name!r} and "
                f"{list(first.shape[1:])} in {names[0]!r}: leave {key!r} out, or the episodes of another shape"
            )
    whole = np.concatenate(parts) if len(parts) > 1 else np.asarray(first)
    if whole.dtype.kind not in "fiub":
        raise TypeError(f"{key!r} of {str(path)!r} is {whole.dtype}, needed are numbers: choose another")
    if whole.dtype.kind == "f" and whole.dtype.itemsize > 8:
        whole = whole.astype(np.float64)
    if whole.dtype.kind == "u" and whole.dtype.itemsize > 1:
        whole = whole.astype(np.int64)
    return torch.from_numpy(np.require(whole, whole.dtype.newbyteorder("="), ["C", "W", "O"]))


def _vector(value: Tensor) -> Tensor:
    """``[N]`` as ``[N, 1]``."""
    return value.unsqueeze(-1) if value.ndim == 1 else value


def _side_by_side(values: Sequence[Tensor]) -> Tensor:
    """Vectors ``[N, D_k]`` as ``[N, sum D_k]``, floating-point."""
    dtypes = [value.dtype for value in values]
    dtype = torch.float32
    for other in dtypes:
        dtype = torch.promote_types(dtype, other)
    return torch.cat([_vector(value).to(dtype) for value in values], -1)


def concatenate_observations(
    demonstrations: TensorDictBase, keys: Sequence[str] | None = None
) -> tuple[TensorDictBase, tuple[tuple[str, int, int], ...]]:
    """Makes one ``observation`` ``[N, O]`` of the vectors of a nested one.

    Args:
        demonstrations: ``[N]`` with a nested ``observation``; not changed.
        keys: of the vectors, in the order of the columns. Default: all, sorted.

    Returns:
        A shallow copy, with next observations treated alike where there are any, and the layout, which gives each key
        its first column and the one after its last.

    Raises:
        KeyError: if a key is missing.
        ValueError: if an entry is no vector.

    Examples:
        >>> parts = {"pose": torch.zeros(4, 3), "grip": torch.ones(4)}
        >>> data, layout = concatenate_observations(TensorDict({"observation": parts}, [4]))
        >>> data["observation"].shape, layout
        (torch.Size([4, 4]), (('grip', 0, 1), ('pose', 1, 4)))
    """
    nested = demonstrations["observation"]
    if isinstance(nested, Tensor):
        raise ValueError("'observation' is one tensor already: there is nothing to concatenate")
    chosen = sorted(nested.keys()) if keys is None else list(keys)
    for key in chosen:
        if key not in nested.keys():  # noqa: SIM118
            raise KeyError(f"the observation has no {key!r}, only {sorted(nested.keys())}")
        if not isinstance(nested[key], Tensor) or nested[key].ndim > 2:
            raise ValueError(f"'observation', {key!r} is no vector a row: leave it out by keys=[...]")
    out, layout, start = demonstrations.copy(), [], 0
    for key in chosen:
        width = _vector(nested[key]).shape[1]
        layout.append((key, start, start + width))
        start += width
    for place in ("observation", ("next", "observation")):
        parts = demonstrations.get(place, None)
        if parts is not None:
            whole = map_rows(
                lambda rows: TensorDict({"all": _side_by_side([rows[key] for key in chosen])}, rows.shape),
                parts.select(*chosen),
            )
            out.set(place, whole["all"])
    return out, tuple(layout)


def _name(key: str) -> str:
    """The key within the nested observation: files' dots and slashes would be taken for nesting."""
    for prefix in ("observation.", "observations/", "obs/"):
        key = key.removeprefix(prefix)
    return key.replace(".", "_").replace("/", "_")


def _observations(parts: dict[str, Tensor], concatenate: bool) -> tuple[Any, tuple[tuple[str, int, int], ...]]:
    """One observation, or a nested one, and the layout of the former."""
    vectors = all(value.ndim <= 2 and (value.ndim == 1 or value.dtype != torch.uint8) for value in parts.values())
    if len(parts) == 1:
        ((key, value),) = parts.items()
        value = _vector(value) if value.is_floating_point() else value
        return value, ((key, 0, value.shape[1]),) if value.ndim == 2 else ()
    if concatenate and vectors:
        layout, start = [], 0
        for key, value in parts.items():
            layout.append((key, start, start + _vector(value).shape[1]))
            start = layout[-1][2]
        return _side_by_side(list(parts.values())), tuple(layout)
    named = {_name(key): value for key, value in parts.items()}
    if len(named) < len(parts):
        raise ValueError(f"two of the keys {sorted(parts)} have the same name within an observation: leave one out")
    return {name: _vector(v) if v.is_floating_point() else v for name, v in named.items()}, ()


def _check_lengths(episode: RawEpisode, path: object) -> int:
    lengths = {key: len(value) for key, value in episode.columns.items()}
    lengths |= {f"next {key}": len(value) for key, value in episode.following.items()}
    if episode.timestamp is not None:
        lengths["timestamp"] = len(episode.timestamp)
    if episode.reward is not None:
        lengths["reward"] = len(episode.reward)
    if len(set(lengths.values())) > 1:
        raise ValueError(f"episode {episode.name!r} of {str(path)!r} has entries of unequal lengths, {lengths}")
    size = next(iter(lengths.values()))
    if not size:
        raise ValueError(f"episode {episode.name!r} of {str(path)!r} is empty: remove it from the file")
    return size


def assemble(reader: Reader) -> Demonstrations:
    """Reads the chosen keys of all episodes into the schema.

    Raises:
        KeyError: if a key is missing.
        TypeError: if an entry is not made of numbers.
        ValueError: if there is no episode, one is empty, or lengths or shapes differ.
    """
    observation, action, reward = _keys(reader)
    options, path = reader.options, reader.path
    keys = list(dict.fromkeys([*observation, *action]))
    following = observation if options.next_observation else []
    episodes = list(reader.episodes(keys, reward, following))
    if not episodes:
        raise ValueError(f"{str(path)!r} holds no episode: record some, or choose another filter_key")
    names = [episode.name for episode in episodes]
    lengths = torch.tensor([_check_lengths(episode, path) for episode in episodes])

    def join(key: str, take: Any) -> Tensor:
        return _tensor([np.asarray(take(episode)) for episode in episodes], key, names, path)

    columns = {key: join(key, lambda episode, k=key: episode.columns[k]) for key in keys}
    value, layout = _observations({key: columns[key] for key in observation}, options.concatenate)
    actions = [columns[key] for key in action]
    size = int(lengths.sum())
    data: dict[str, Any] = {"observation": value}
    if len(actions) > 1:
        data["action"] = _side_by_side(actions)
    else:
        data["action"] = _vector(actions[0]) if actions[0].is_floating_point() else actions[0]
    after: dict[str, Any] = {}
    if following:
        after["observation"], _ = _observations(
            {key: join(f"next {key}", lambda episode, k=key: episode.following[k]) for key in following},
            options.concatenate,
        )
    if reward is not None:
        after["reward"] = join(reward, lambda episode: episode.reward).reshape(size, -1).float()
    ends, starts = lengths.cumsum(0) - 1, lengths.cumsum(0) - lengths
    step = torch.arange(size) - starts.repeat_interleave(lengths)
    if not reader.pairs:
        flags = {name: torch.zeros(size, 1, dtype=torch.bool) for name in ("done", "terminated", "truncated")}
        terminated = torch.tensor([episode.terminated for episode in episodes])
        flags["done"][ends] = True
        flags["terminated"][ends[terminated]] = True
        flags["truncated"][ends[~terminated]] = True
        after |= flags
        data["is_init"] = (step == 0)[:, None]
        data["episode"] = torch.arange(len(lengths)).repeat_interleave(lengths)
    if after:
        data["next"] = after
    data["info"] = {"step": step}
    if all(episode.timestamp is not None for episode in episodes):
        data["info"]["timestamp"] = join("timestamp", lambda episode: episode.timestamp).reshape(size).double()
    left_out = tuple(key for key in reader.columns() if key not in (*keys, reward))
    source = Provenance(
        reader.name, str(path), tuple(observation), tuple(action), layout, left_out, tuple(names), reader.facts()
    )
    return Demonstrations(TensorDict(data, [size]).auto_batch_size_(1), source)
