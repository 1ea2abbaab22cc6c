"""The storage under all buffers of demonstrations: rows on disk, never written to, read a batch at a time."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, TensorDictReplayBuffer, TensorStorage
from torchrl.data.replay_buffers.samplers import Sampler

from torchrl_tsallis._checks import check_path, shown
from torchrl_tsallis._device import check_device
from torchrl_tsallis.data.rows import is_memory_mapped, store_rows

_log = logging.getLogger(__name__)


def as_dtype(rows: TensorDictBase, dtype: torch.dtype | None) -> TensorDictBase:
    """The same rows with all floating-point numbers of one dtype; None: as they are."""
    return rows if dtype is None else rows.apply(lambda x: x.to(dtype) if x.is_floating_point() else x)


def single_precision(rows: TensorDictBase) -> TensorDictBase:
    """The same rows with float32 in the place of float64; the first time, a logged notice says so."""
    double = [key for key, value in rows.items(True, True) if value.dtype == torch.float64]
    if not double:
        return rows
    _notice(tuple(double))
    return as_dtype(rows, torch.float32)


@cache
def _notice(keys: tuple[NestedKey, ...]) -> None:
    _log.warning("%s are float64 and the loss is float32: batches are converted (loss.double() keeps them)", keys)


class RowStorage(TensorStorage):
    """Rows of demonstrations, which a buffer reads and never writes.

    Args:
        rows: the demonstrations, ``[N]``.
        dtype: of the floating-point numbers that are read. Default: as stored.
        device: to copy the rows to, such as a GPU. Default: as they are; those on disk stay there.
    """

    _storage: Any

    def __init__(
        self,
        rows: TensorDictBase,
        *,
        dtype: torch.dtype | None = None,
        device: str | torch.device | None = None,
    ) -> None:
        elsewhere = None if device is None or check_device(device).type == "cpu" else torch.device(device)
        super().__init__(rows if elsewhere is None else as_dtype(rows, dtype).to(elsewhere))
        self.dtype, self._elsewhere = dtype, elsewhere

    def get(self, index: Any) -> Any:
        """Rows ``[B]`` or ``[S, B]``; the latter one by one in a row: general indexing takes several times as long."""
        if self._elsewhere is not None and isinstance(index, torch.Tensor):
            index = index.to(self._elsewhere)
        if isinstance(index, torch.Tensor) and index.ndim == 2:
            flat, shape = index.flatten(), index.shape
            out = self._storage.apply(lambda x: x.index_select(0, flat).unflatten(0, shape), batch_size=shape)
        else:
            out = super().get(index)
        return as_dtype(out, self.dtype)

    def replace(self, entries: Mapping[NestedKey, Tensor]) -> None:
        """Puts other tensors ``[N, *]`` in the place of some entries; what lies on disk stays as it is."""
        rows = TensorDict(self._storage.to_dict(), [len(self._storage)])
        for key, value in entries.items():
            rows.set(key, value)
        self._storage = rows


def check_batch_size(**sizes: Any) -> None:
    """Raises for a size that is no positive whole number; the message names it."""
    for name, value in sizes.items():
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise ValueError(f"{name}={shown(value)} must be a positive whole number")


def make_storage(
    parts: Sequence[TensorDictBase],
    scratch_dir: str | os.PathLike[str] | None,
    *,
    dtype: torch.dtype | None,
    device: str | torch.device | None = None,
) -> RowStorage:
    """Stores rows, one part after the other; memory-mapped rows stay where they are.

    Args:
        parts: tensordicts ``[N_k]`` of what to store, and nothing else.
        scratch_dir: folder of the memory map where one is written.
        dtype: of the floating-point numbers in batches. Default: as in the parts.
        device: that the rows are copied to. Default: none.

    Returns:
        The storage, ``[sum N_k]``.

    Raises:
        ValueError: if the parts' entries differ in key, shape or dtype, or ``dtype`` is no floating-point one.
    """
    if dtype is not None and not (isinstance(dtype, torch.dtype) and dtype.is_floating_point):
        raise ValueError(f"dtype={shown(dtype)} must be a floating-point dtype such as torch.float32")
    if scratch_dir is not None:
        scratch_dir = check_path("scratch_dir", scratch_dir)
    layouts = [{key: (tuple(x.shape[1:]), x.dtype) for key, x in part.items(True, True)} for part in parts]
    for layout in layouts[1:]:
        for key in layout.keys() | layouts[0].keys():
            if layout.get(key) != layouts[0].get(key):
                raise ValueError(
                    f"{key!r} is {layouts[0].get(key)} in the first demonstrations and {layout.get(key)} in others: "
                    "members of one buffer need the same entries, shapes and dtypes"
                )
    if len(parts) == 1 and is_memory_mapped(parts[0]):
        return RowStorage(parts[0], dtype=dtype, device=device)
    rows = store_rows(parts, scratch_dir=scratch_dir, convert=lambda rows: as_dtype(rows, dtype))
    return RowStorage(rows, device=device)


def make_buffer(storage: RowStorage, sampler: Sampler, batch_size: int) -> TensorDictReplayBuffer:
    """A buffer over rows that nothing can be written to: they may be a user's own files."""
    return TensorDictReplayBuffer(
        storage=storage, sampler=sampler, writer=ImmutableDatasetWriter(), batch_size=batch_size
    )
