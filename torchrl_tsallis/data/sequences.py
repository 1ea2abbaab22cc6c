"""Demonstrations as sequences: a buffer of slices for recurrent policies."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, SliceSamplerWithoutReplacement, TensorDictReplayBuffer

from torchrl_tsallis._checks import check_keys, check_seed
from torchrl_tsallis._device import check_device
from torchrl_tsallis.data.episodes import ENDS, IS_INIT, Episodes, find_episodes, read_flag
from torchrl_tsallis.data.schema import check_layout, check_rows
from torchrl_tsallis.data.storage import check_batch_size, make_storage

_KEYS: tuple[NestedKey, ...] = ("observation", "action", "is_init", ("next", "observation"))


class SequenceReplayBuffer(TensorDictReplayBuffer):
    """TorchRL's buffer, whose samples of slices have a time dimension.

    A transform could not give it: TorchRL writes what the sampler knows into the flat sample afterwards.

    Args:
        slice_len: steps T a slice.
        **kwargs: as for ``TensorDictReplayBuffer``.
    """

    def __init__(self, *, slice_len: int, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.slice_len = slice_len

    def sample(self, *args: Any, **kwargs: Any) -> Any:
        """Samples slices, ``[B, T]``; as ``TensorDictReplayBuffer``'s."""
        out = super().sample(*args, **kwargs)
        if isinstance(out, tuple):
            return out[0].reshape(-1, self.slice_len), out[1]
        return out.reshape(-1, self.slice_len)


def make_sequence_buffer(
    demonstrations: TensorDictBase,
    *,
    slice_len: int,
    num_slices: int,
    seed: int = 0,
    keys: Sequence[NestedKey] = _KEYS,
    scratch_dir: str | os.PathLike[str] | None = None,
    dtype: torch.dtype | None = None,
    device: str | torch.device | None = None,
) -> SequenceReplayBuffer:
    """Puts trajectories into a memory-mapped buffer that gives slices of them, ``[num_slices, slice_len]``.

    An epoch takes one slice from every trajectory, from a random place in it; a slice never spans two trajectories,
    and its first step has ``is_init`` set. Slices of the trajectories' own length see each step equally often and
    start as a trial does; the ends of longer trajectories are seen less.

    Only ``keys`` and the trajectories' ends are stored: ground-truth labels under ``info`` cannot reach training.

    Args:
        demonstrations: trajectories one after the other, ``[N]``, see :mod:`torchrl_tsallis.data.schema`.
        slice_len: steps T a slice.
        num_slices: slices B a batch; an epoch's last, smaller batch is dropped.
        seed: of the order and the places.
        keys: the entries to store.
        scratch_dir: folder of the memory map; it may exist, and a second start finds its rows there. Default: shared
            memory.
        dtype: of the floating-point numbers in batches, such as torch.float32 for NumPy's float64. Default: as stored;
            the offline trainer gives a float32 loss float32, with a logged notice.
        device: of the batches, such as a GPU. Default: memory.

    Returns:
        The buffer; ``sample()`` gives ``[B, T]``. It cannot be written to. Flags are ``[B, T, 1]``, and ``done`` is
        set where an episode ends for whatever reason.

    Raises:
        ValueError: if a trajectory is shorter than a slice, there are fewer of them than slices in a batch, an entry
            is not finite, or it cannot be told where trajectories end.
        KeyError: if an entry is missing.
        TypeError: if an entry is no tensor of real numbers.
        OSError: if ``scratch_dir`` cannot be written.

    Examples:
        >>> from tensordict import TensorDict
        >>> data = TensorDict({"observation": torch.zeros(8, 3), "action": torch.zeros(8, 2)}, [8])
        >>> data["is_init"] = (torch.arange(8) % 4 == 0)[:, None]
        >>> data["next"] = TensorDict({"observation": torch.zeros(8, 3), "done": data["is_init"].roll(-1, 0)}, [8])
        >>> make_sequence_buffer(data, slice_len=4, num_slices=2).sample()["action"].shape
        torch.Size([2, 4, 2])
    """
    check_batch_size(slice_len=slice_len, num_slices=num_slices)
    seed, keys = check_seed("seed", seed), check_keys("keys", keys)
    check_layout(demonstrations)
    stored = [*keys, *(key for key in ENDS if key in demonstrations.keys(True) and key not in keys)]
    check_rows(demonstrations, stored, whole_episodes=True)
    episodes = find_episodes(demonstrations, purpose="a buffer of slices")
    shortest = int(episodes.lengths.min())
    if shortest < slice_len or len(episodes.starts) < num_slices:
        raise ValueError(
            f"{len(episodes.starts)} trajectories of at least {shortest} steps do not give {num_slices} slices of "
            f"{slice_len}: lower num_slices or slice_len"
        )
    storage = make_storage([demonstrations.select(*stored)], scratch_dir, dtype=dtype)
    storage.replace(_flags(demonstrations, episodes, stored))
    sampler = SliceSamplerWithoutReplacement(slice_len=slice_len, end_key=("next", "done"), drop_last=True)
    buffer = SequenceReplayBuffer(
        storage=storage,
        sampler=sampler,
        writer=ImmutableDatasetWriter(),
        batch_size=slice_len * num_slices,
        slice_len=slice_len,
    )
    buffer.set_rng(torch.Generator().manual_seed(seed))
    if device is not None and check_device(device).type != "cpu":
        buffer.append_transform(lambda batch: batch.to(device))
    return buffer


def _flags(demonstrations: TensorDictBase, episodes: Episodes, stored: Sequence[NestedKey]) -> dict[NestedKey, Tensor]:
    """The flags as TorchRL's sampler needs them: bool ``[N, 1]``, and ``done`` at the end of every episode."""
    flags: dict[NestedKey, Tensor] = {}
    for key in (*ENDS, IS_INIT):
        value = read_flag(demonstrations, key) if key in stored else None
        if value is not None:
            flags[key] = value.bool().unsqueeze(-1)
    flags["next", "done"] = torch.zeros(len(demonstrations), 1, dtype=torch.bool)
    flags["next", "done"][episodes.ends] = True
    return flags
