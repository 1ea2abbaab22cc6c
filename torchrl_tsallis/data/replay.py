"""Replay buffers of demonstrations."""

from __future__ import annotations

import os
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import LazyMemmapStorage, SamplerWithoutReplacement, TensorDictReplayBuffer


def check_rows(demonstrations: TensorDictBase, batch_size: int, keys: Sequence[NestedKey]) -> None:
    """Raises for what cannot be trained on; see :func:`make_replay_buffer`."""
    size = len(demonstrations)
    if size < batch_size:
        raise ValueError(f"{size} samples are fewer than a batch of {batch_size}: record more, or lower batch_size")
    for key in keys:
        value = demonstrations.get(key, None)
        if value is None:
            raise KeyError(f"the demonstrations have no {key!r}, only {sorted(map(str, demonstrations.keys(True)))}")
        bad = (~value.isfinite().flatten(1).all(1)).nonzero()[:, 0].tolist()
        if bad:
            raise ValueError(
                f"{key!r} is NaN or infinite in {len(bad)} of {size} rows, first {bad[:5]}: remove those rows"
            )


def make_replay_buffer(
    demonstrations: TensorDictBase,
    *,
    batch_size: int = 256,
    seed: int = 0,
    keys: Sequence[NestedKey] = ("observation", "action"),
    scratch_dir: str | os.PathLike[str] | None = None,
) -> TensorDictReplayBuffer:
    """Puts demonstrations into a memory-mapped buffer that is sampled epoch by epoch.

    Only ``keys`` are stored: ground-truth labels under ``info`` cannot reach training.

    Args:
        demonstrations: flat ``[N]``.
        batch_size: samples a batch (256, section V-B); an epoch's last, shorter batch is dropped.
        seed: of the order of the samples.
        keys: the entries to store.
        scratch_dir: folder of the memory map. Default: a temporary one.

    Returns:
        The buffer.

    Raises:
        ValueError: if the data is smaller than a batch or not finite; the message names key and rows.
        KeyError: if a key is missing.

    Examples:
        >>> from tensordict import TensorDict
        >>> data = TensorDict({"observation": torch.zeros(8, 3), "action": torch.zeros(8, 2)}, [8])
        >>> make_replay_buffer(data, batch_size=4).sample()["action"].shape
        torch.Size([4, 2])
    """
    check_rows(demonstrations, batch_size, keys)
    buffer = TensorDictReplayBuffer(
        storage=LazyMemmapStorage(len(demonstrations), scratch_dir=scratch_dir),
        sampler=SamplerWithoutReplacement(drop_last=True),
        batch_size=batch_size,
    )
    buffer.set_rng(torch.Generator().manual_seed(seed))
    buffer.extend(demonstrations.select(*keys))
    return buffer
