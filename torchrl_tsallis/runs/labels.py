"""What users know of their demonstrations, to compare what was found with: never an input of the search."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_tsallis.data.readers import open_reader
from torchrl_tsallis.data.readers.base import Options, one_label
from torchrl_tsallis.modes.consensus import adjusted_rand_index
from torchrl_tsallis.runs.source import Source


def read_labels(
    path_or_data: str | os.PathLike[str] | TensorDictBase, source: Source, key: str, options: dict[str, Any]
) -> list[str]:
    """What the data say of each episode under a key.

    Args:
        path_or_data: file, folder, or demonstrations in memory ``[N]``.
        source: what was read of it.
        key: of a column or tensor with one value an episode; ``mask`` for the filter keys of robomimic.
        options: by which it was read.

    Returns:
        The labels, as text, in the order of the source's episodes.

    Raises:
        KeyError: if there is no such key.
        ValueError: if it changes within an episode.
    """
    if isinstance(path_or_data, TensorDictBase):
        if key not in path_or_data.keys(True):
            raise KeyError(f"the data have no {key!r} to compare with: name an entry with one value a row")
        values, episodes = path_or_data[key].reshape(len(path_or_data), -1)[:, 0].tolist(), source.episodes()
        cuts = zip(source.names, episodes.starts.tolist(), episodes.lengths.tolist(), strict=True)
        return [one_label(values[start : start + size], key, name, Path("data")) for name, start, size in cuts]
    names = ("observation", "action", "episode", "filter_key")
    chosen = Options(**{name: options[name] for name in names})
    found = open_reader(path_or_data, chosen, format=options["format"]).labels(key)
    return [found[name] for name in source.names]


def compare_labels(labels: Sequence[str], mode: Sequence[int]) -> dict[str, Any]:
    """How labels and modes go together.

    Args:
        labels: of each episode.
        mode: of each episode.

    Returns:
        The adjusted Rand index between them, and the episodes of each label by mode.

    Examples:
        >>> compare_labels(["anna", "anna", "ben"], [0, 0, 1])
        {'rand_index': 1.0, 'episodes': {'anna': {'0': 2}, 'ben': {'1': 1}}}
    """
    names = sorted(set(labels))
    numbers = torch.tensor([names.index(label) for label in labels])
    table: dict[str, dict[str, int]] = {name: {} for name in names}
    for label, number in sorted(zip(labels, mode, strict=True), key=lambda pair: pair[1]):
        table[label][str(number)] = table[label].get(str(number), 0) + 1
    return {"rand_index": adjusted_rand_index(numbers, torch.tensor(list(mode))), "episodes": table}
