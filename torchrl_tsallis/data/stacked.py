"""Replay buffers that give a batch to each of several stacked members."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.storages import Storage

from torchrl_tsallis._checks import check_keys, check_seed, shown
from torchrl_tsallis.data.schema import check_layout, check_rows
from torchrl_tsallis.data.storage import check_batch_size, make_buffer, make_storage


def check_seeds(seeds: Any) -> list[int]:
    """Raises for what is no sequence of seeds, one a member; returns them as a list.

    Examples:
        >>> check_seeds([0, 1.5])
        Traceback (most recent call last):
        ...
        TypeError: seeds[1] must be an integer, got 1.5
    """
    listed = seeds.tolist() if isinstance(seeds, (torch.Tensor, np.ndarray)) else seeds
    if isinstance(listed, (str, bytes)) or not isinstance(listed, Sequence):
        raise TypeError(f"seeds must be a sequence of integers, one a member, got {shown(seeds)}")
    return [check_seed(f"seeds[{i}]", seed) for i, seed in enumerate(listed)]


class MemberSampler(Sampler):
    """Samples without replacement for S members at once, each by a random order of its own.

    Member k gets the rows that ``SamplerWithoutReplacement(drop_last=True)`` with a generator of the seed k gives, in
    the same order, so that a stacked run sees what the single runs see.

    Args:
        seeds: one for each member.
        rows: where the data of each member is in the storage; members may share it.

    Raises:
        ValueError: if the numbers differ, and in :meth:`sample` if a member has fewer rows than a batch.

    Examples:
        >>> sampler = MemberSampler(seeds=[0, 1], rows=[range(0, 8), range(8, 16)])
        >>> index, _ = sampler.sample(None, batch_size=4)
        >>> index.shape, bool((index[1] >= 8).all())
        (torch.Size([2, 4]), True)
    """

    def __init__(self, seeds: Sequence[int], rows: Sequence[range]) -> None:
        seeds = check_seeds(seeds)
        if isinstance(rows, str) or not isinstance(rows, Sequence) or not all(isinstance(r, range) for r in rows):
            raise TypeError(f"rows must be a sequence of ranges, one a member, got {shown(rows)}")
        if len(seeds) != len(rows) or not rows:
            raise ValueError(f"{len(seeds)} seeds and {len(rows)} ranges of rows were given: give one of each a member")
        self.rows = list(rows)
        self.generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        self._empty()

    def _empty(self) -> None:
        """Forgets the current orders; the next sample draws new ones."""
        self._orders = [torch.empty(0, dtype=torch.int64) for _ in self.rows]
        self._together: torch.Tensor | None = None  # the orders as one tensor, while all members are at one position
        self._positions = [0 for _ in self.rows]
        self._before = [generator.get_state() for generator in self.generators]

    def _draw(self, member: int) -> None:
        """A new order; the generator's state before it is all that a checkpoint needs of it."""
        rows, generator = self.rows[member], self.generators[member]
        self._before[member] = generator.get_state()
        self._orders[member] = torch.randperm(len(rows), generator=generator).add_(rows.start)
        self._together = None
        self._positions[member] = 0

    def sample(self, storage: Storage | None, batch_size: int) -> tuple[torch.Tensor, dict[str, Any]]:
        """Rows of the next batches, ``[S, batch_size]``."""
        start = self._positions[0]
        if self._together is not None and start + batch_size <= self._together.shape[1]:
            self._positions = [start + batch_size] * len(self.rows)
            return self._together[:, start : start + batch_size].clone(), {}
        index = []
        for member, rows in enumerate(self.rows):
            if len(rows) < batch_size:
                raise ValueError(f"member {member} has {len(rows)} samples, fewer than a batch of {batch_size}")
            start = self._positions[member]
            if start + batch_size > len(self._orders[member]):
                self._draw(member)
                start = 0
            index.append(self._orders[member][start : start + batch_size])
            self._positions[member] = start + batch_size
        if self._together is None and len(set(self._positions)) == len({len(order) for order in self._orders}) == 1:
            self._together = torch.stack(self._orders)
            self._orders = list(self._together)  # views: the orders are there once
        return torch.stack(index), {}

    def state_dict(self) -> dict[str, Any]:
        """The random states before the current orders, and the positions in them."""
        return {
            "len_storage": max(rows.stop for rows in self.rows),
            "generators": torch.stack(self._before),
            "positions": torch.tensor(self._positions),
            "drawn": torch.tensor([len(order) > 0 for order in self._orders]),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores the state, by drawing the current orders again."""
        if len(state_dict["generators"]) != len(self.rows):
            raise ValueError(
                f"the state is that of {len(state_dict['generators'])} members, there are {len(self.rows)}: resume "
                "with the same seeds"
            )
        self._empty()
        for member, state in enumerate(state_dict["generators"]):
            self.generators[member].set_state(state.clone())
            if state_dict["drawn"][member]:
                self._draw(member)
                self._positions[member] = int(state_dict["positions"][member])
        self._before = [state.clone() for state in state_dict["generators"]]

    def dumps(self, path: str | os.PathLike[str]) -> None:
        """Saves the state in a folder."""
        Path(path).mkdir(exist_ok=True)
        TensorDict(self.state_dict()).memmap(path)

    def loads(self, path: str | os.PathLike[str]) -> None:
        """Loads the state from a folder."""
        self.load_state_dict(TensorDict.load_memmap(path).to_dict())


def make_stacked_replay_buffer(
    demonstrations: TensorDictBase | Sequence[TensorDictBase],
    *,
    seeds: Sequence[int],
    batch_size: int = 256,
    keys: Sequence[NestedKey] = ("observation", "action"),
    scratch_dir: str | os.PathLike[str] | None = None,
    dtype: torch.dtype | None = None,
    device: str | torch.device | None = None,
) -> TensorDictReplayBuffer:
    """Puts the demonstrations of S members into one memory-mapped buffer; ``sample()`` gives ``[S, batch_size]``.

    Member k gets the batches of ``make_replay_buffer(demonstrations[k], seed=seeds[k])``, in the same order.

    Args:
        demonstrations: flat ``[N]`` for all members, or one for each of them, ``[N_k]``. One that is given more than
            once is stored once.
        seeds: of the order of each member's samples.
        batch_size: samples a batch and member (256, section V-B); an epoch's last, shorter batch is dropped.
        keys: the entries to store.
        scratch_dir: folder of the memory map; it may exist, and a second start finds its rows there. Default: shared
            memory.
        dtype: of the floating-point numbers in batches, such as torch.float32 for NumPy's float64. Default: as stored;
            the offline trainer gives a float32 loss float32, with a logged notice.
        device: that the rows are copied to, such as a GPU, and batches come from. Default: rows stay on disk.

    Returns:
        The buffer. It cannot be written to.

    Raises:
        ValueError: if the data is smaller than a batch or not finite, the numbers of members differ, or their entries.
        KeyError: if a key is missing.
        TypeError: if an entry is no tensor of real numbers.
        OSError: if ``scratch_dir`` cannot be written.

    Examples:
        >>> data = TensorDict({"observation": torch.zeros(8, 3), "action": torch.zeros(8, 2)}, [8])
        >>> make_stacked_replay_buffer(data, seeds=[0, 1, 2], batch_size=4).sample()["action"].shape
        torch.Size([3, 4, 2])
    """
    seeds, keys = check_seeds(seeds), check_keys("keys", keys)
    shared = isinstance(demonstrations, TensorDictBase)
    if not shared and (not isinstance(demonstrations, (list, tuple)) or len(demonstrations) != len(seeds)):
        given = f"{len(demonstrations)} of them" if isinstance(demonstrations, (list, tuple)) else shown(demonstrations)
        raise TypeError(
            f"demonstrations must be a TensorDict for all members, or a list of {len(seeds)}, as many as seeds, got "
            f"{given}"
        )
    members: list[TensorDictBase] = [demonstrations] * len(seeds) if shared else list(demonstrations)
    unique = {id(member): member for member in members}
    check_batch_size(batch_size=batch_size)
    total = sum(check_layout(member) for member in unique.values())
    rows, start = {}, 0
    for name, member in unique.items():
        check_rows(member, keys, least=batch_size, before=start, total=total)
        rows[name] = range(start, start + len(member))
        start += len(member)
    sampler = MemberSampler(seeds, [rows[id(member)] for member in members])
    together = [member.select(*keys) for member in unique.values()]
    storage = make_storage(together, scratch_dir, dtype=dtype, device=device)
    return make_buffer(storage, sampler, batch_size)
