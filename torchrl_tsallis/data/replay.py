"""Replay buffers of demonstrations."""

from __future__ import annotations

import os
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import SamplerWithoutReplacement, TensorDictReplayBuffer

from torchrl_tsallis._checks import check_keys, check_seed
from torchrl_tsallis.data.schema import check_rows
from torchrl_tsallis.data.storage import check_batch_size, make_buffer, make_storage


def make_replay_buffer(
    demonstrations: TensorDictBase,
    *,
    batch_size: int = 256,
    seed: int = 0,
    keys: Sequence[NestedKey] = ("observation", "action"),
    scratch_dir: str | os.PathLike[str] | None = None,
    dtype: torch.dtype | None = None,
    device: str | torch.device | None = None,
) -> TensorDictReplayBuffer:
    """Puts demonstrations into a memory-mapped buffer that is sampled epoch by epoch.

    Only ``keys`` are stored: ground-truth labels under ``info`` cannot reach training. Demonstrations that are
    memory-mapped already are read where they are, not copied.

    Args:
        demonstrations: flat ``[N]``, see :mod:`torchrl_tsallis.data.schema`; episodes are not needed.
        batch_size: samples a batch (256, section V-B); an epoch's last, shorter batch is dropped.
        seed: of the order of the samples.
        keys: the entries to store.
        scratch_dir: folder of the memory map; it may exist, and a second start finds its rows there. Default: shared
            memory.
        dtype: of the floating-point numbers in batches, such as torch.float32 for NumPy's float64. Default: as stored;
            the offline trainer gives a float32 loss float32, with a logged notice.
        device: that the rows are copied to, such as a GPU, and batches come from. Default: rows stay on disk.

    Returns:
        The buffer. It cannot be written to.

    Raises:
        ValueError: if the data is smaller than a batch or not finite; the message names key and rows.
        KeyError: if a key is missing.
        TypeError: if an entry is no tensor of real numbers.
        OSError: if ``scratch_dir`` cannot be written.

    Examples:
        >>> from tensordict import TensorDict
        >>> data = TensorDict({"observation": torch.zeros(8, 3), "action": torch.zeros(8, 2)}, [8])
        >>> make_replay_buffer(data, batch_size=4).sample()["action"].shape
        torch.Size([4, 2])
    """
    check_batch_size(batch_size=batch_size)
    seed, keys = check_seed("seed", seed), check_keys("keys", keys)
    check_rows(demonstrations, keys, least=batch_size)
    storage = make_storage([demonstrations.select(*keys)], scratch_dir, dtype=dtype, device=device)
    buffer = make_buffer(storage, SamplerWithoutReplacement(drop_last=True), batch_size)
    buffer.set_rng(torch.Generator().manual_seed(seed))
    return buffer
