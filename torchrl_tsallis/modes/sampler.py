"""Samples of stacked members that draw episodes in proportion to weights of their own."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.storages import Storage

from torchrl_tsallis.data.episodes import Episodes, find_episodes
from torchrl_tsallis.data.schema import check_layout, check_rows
from torchrl_tsallis.data.storage import check_batch_size, make_buffer, make_storage


class EpisodeSampler(Sampler):
    """Draws rows with replacement for S members at once, each by a weight for every episode.

    A row of an episode is drawn in proportion to the episode's weight, so that long episodes give more rows.

    Args:
        episodes: where they are in the storage.
        seeds: one a member.

    Attributes:
        weights: ``[S, E]``, not negative; each row of it has something positive. Default: 1 everywhere.

    Raises:
        ValueError: if there is no seed.

    Examples:
        >>> sampler = EpisodeSampler(Episodes(torch.tensor([0, 3]), torch.tensor([3, 2])), seeds=[0, 1])
        >>> sampler.weights = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
        >>> index, _ = sampler.sample(None, 4)
        >>> bool((index[0] < 3).all()), bool((index[1] >= 3).all())
        (True, True)
    """

    def __init__(self, episodes: Episodes, seeds: Sequence[int]) -> None:
        if not len(seeds):
            raise ValueError("no seed was given: give one a member")
        self.episodes = episodes
        self.generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        self.weights = torch.ones(len(seeds), len(episodes.starts))

    @property
    def weights(self) -> Tensor:
        """Weight of each episode for each member, ``[S, E]``."""
        return self._weights

    @weights.setter
    def weights(self, value: Tensor) -> None:
        shape = (len(self.generators), len(self.episodes.starts))
        if value.shape != shape:
            raise ValueError(f"the weights have shape {list(value.shape)}, needed is {list(shape)}: [S, E]")
        total = value.double().sum(1)
        if not (bool((value >= 0).all()) and bool((total > 0).all() & total.isfinite().all())):
            raise ValueError("weights must be finite and not negative, and each member needs an episode")
        self._weights = value.double()
        mass = self._weights * self.episodes.lengths
        self._cumulative = (mass / mass.sum(1, keepdim=True)).cumsum(1)

    def sample(self, storage: Storage | None, batch_size: int) -> tuple[Tensor, dict[str, Any]]:
        """Rows of the next batches, ``[S, batch_size]``."""
        drawn = torch.stack(
            [torch.rand(2, batch_size, generator=generator, dtype=torch.float64) for generator in self.generators]
        )
        which = torch.searchsorted(self._cumulative, drawn[:, 0].contiguous(), right=True)
        # A sum that rounding leaves below 1 must not give an episode that does not exist, or has no weight.
        last = (self._weights > 0).long() * torch.arange(1, self._weights.shape[1] + 1)
        which = torch.minimum(which, last.amax(1, keepdim=True) - 1)
        step = (drawn[:, 1] * self.episodes.lengths[which]).long()
        return self.episodes.starts[which] + step, {}

    def state_dict(self) -> dict[str, Any]:
        """The weights and the random states."""
        states = torch.stack([generator.get_state() for generator in self.generators])
        return {"generators": states, "weights": self._weights.clone()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores the state."""
        if len(state_dict["generators"]) != len(self.generators):
            raise ValueError(
                f"the state is that of {len(state_dict['generators'])} members, there are {len(self.generators)}: "
                "resume with the same components"
            )
        for generator, state in zip(self.generators, state_dict["generators"], strict=True):
            generator.set_state(state.clone())
        self.weights = state_dict["weights"]

    def _empty(self) -> None:
        """Nothing is kept between samples."""

    def dumps(self, path: str | os.PathLike[str]) -> None:
        """Saves the state in a folder."""
        Path(path).mkdir(exist_ok=True)
        TensorDict(self.state_dict()).memmap(path)

    def loads(self, path: str | os.PathLike[str]) -> None:
        """Loads the state from a folder."""
        self.load_state_dict(TensorDict.load_memmap(path).to_dict())


def make_episode_buffer(
    demonstrations: TensorDictBase,
    *,
    seeds: Sequence[int],
    batch_size: int = 256,
    keys: Sequence[NestedKey] = ("observation", "action"),
    scratch_dir: str | os.PathLike[str] | None = None,
    dtype: torch.dtype | None = None,
    device: str | torch.device | None = None,
) -> TensorDictReplayBuffer:
    """Puts demonstrations into a buffer from which each member draws episodes by its own weights, ``[S, batch_size]``.

    Args:
        demonstrations: episodes one after the other, ``[N]``.
        seeds: one a member.
        batch_size: samples a batch and member.
        keys: the entries to store.
        scratch_dir: folder of the memory map. Default: shared memory.
        dtype: of the floating-point numbers in batches. Default: as stored.
        device: that the rows are copied to, such as a GPU, and batches come from. Default: rows stay on disk.

    Returns:
        The buffer; ``sampler.weights`` may be changed between samples. It cannot be written to.

    Raises:
        ValueError: if the data are pairs without episodes, or not finite.
        KeyError: if a key is missing.
        TypeError: if an entry is no tensor of real numbers.

    Examples:
        >>> data = TensorDict({"observation": torch.zeros(8, 3), "action": torch.zeros(8, 2)}, [8])
        >>> data["episode"] = torch.arange(8) // 4
        >>> make_episode_buffer(data, seeds=[0, 1, 2], batch_size=4).sample()["action"].shape
        torch.Size([3, 4, 2])
    """
    check_batch_size(batch_size=batch_size)
    check_layout(demonstrations)
    check_rows(demonstrations, keys)
    episodes = find_episodes(demonstrations, purpose="a mixture of whole episodes")
    storage = make_storage([demonstrations.select(*keys)], scratch_dir, dtype=dtype, device=device)
    return make_buffer(storage, EpisodeSampler(episodes, seeds), batch_size)
