"""Demonstrations as sequences: units, split by trajectory, and a buffer of slices for recurrent policies."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import LazyMemmapStorage, SliceSamplerWithoutReplacement, TensorDictReplayBuffer

_ENDS: list[NestedKey] = [("next", name) for name in ("done", "terminated", "truncated")]
_KEYS: tuple[NestedKey, ...] = ("observation", "action", "is_init", ("next", "observation"))


@dataclass(frozen=True)
class Scaling:
    """Units of what the network sees: standardised observations, and actions in multiples of one unit.

    The density of the action has the unit of the action, and with it q and gamma: ``action_unit`` decides in which
    regime the method works. One unit for all directions keeps the geometry of a force.

    Args:
        mean: of the observation, ``[O]``.
        std: of the observation, ``[O]``, positive.
        action_unit: the action's unit, e.g. in N.

    Examples:
        >>> from tensordict import TensorDict
        >>> data = TensorDict({"observation": torch.tensor([[1.0], [3.0]]), "action": torch.ones(2, 1)}, [2])
        >>> Scaling.fit(data, action_unit=0.5)(data)["observation"][:, 0]
        tensor([-1.,  1.])
    """

    mean: Tensor
    std: Tensor
    action_unit: float

    @classmethod
    def fit(cls, demonstrations: TensorDictBase, *, action_unit: float) -> Scaling:
        """Takes mean and (biased) deviation from demonstrations ``[N]``; what is constant is only centred.

        Raises:
            ValueError: if the unit is not positive.
        """
        if not action_unit > 0:
            raise ValueError(f"action_unit must be positive, got {action_unit}")
        observation = demonstrations["observation"].flatten(0, -2).double()
        std, mean = torch.std_mean(observation, 0, correction=0)
        std = std.where(std > 1e-9 * (1 + mean.abs()), 1.0)
        return cls(mean.float(), std.float(), float(action_unit))

    def __call__(self, demonstrations: TensorDictBase) -> TensorDictBase:
        """Scales observations ``[*B, O]``, next ones where there are any, and actions ``[*B, A]``; a shallow copy."""
        out = demonstrations.copy()
        for key in ("observation", ("next", "observation")):
            value = out.get(key, None)
            if value is not None:
                out.set(key, (value - self.mean) / self.std)
        return out.set("action", out["action"] / self.action_unit)

    def state_dict(self) -> dict[str, Tensor]:
        """Tensors to be saved beside a policy."""
        unit = torch.tensor([self.action_unit])
        return {"observation_mean": self.mean, "observation_std": self.std, "action_unit": unit}

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any]) -> Scaling:
        """What :meth:`state_dict` gave."""
        return cls(state["observation_mean"], state["observation_std"], float(state["action_unit"]))


def split_trajectories(demonstrations: TensorDictBase, share: float, *, seed: int = 0) -> tuple[Any, Any]:
    """Splits demonstrations into training and validation by whole trajectories.

    Args:
        demonstrations: trajectories one after the other, ``[N]``, with ``("next", "done")``.
        share: of the trajectories that are kept for validation, in (0, 1); at least one.
        seed: of the choice.

    Returns:
        Training and validation data, ``[N1]`` and ``[N2]``, in the recorded order.

    Raises:
        ValueError: if a side would be empty, or the last trajectory has no end.

    Examples:
        >>> from tensordict import TensorDict
        >>> done = torch.tensor([False, True, False, True])[:, None]
        >>> data = TensorDict({"next": {"done": done}, "x": torch.arange(4)}, [4])
        >>> sorted(len(part) for part in split_trajectories(data, 0.5))
        [2, 2]
    """
    done = demonstrations["next", "done"].reshape(-1)
    if not done[-1]:
        raise ValueError("the last trajectory has no end: set ('next', 'done') at its last step")
    number = done.cumsum(0) - done.long()  # of each step's trajectory
    count = int(number[-1]) + 1
    held_out = max(1, round(share * count))
    if not 0 < share < 1 or held_out >= count:
        raise ValueError(f"a share of {share} of {count} trajectories leaves nothing on one side")
    chosen = torch.randperm(count, generator=torch.Generator().manual_seed(seed))[:held_out]
    validation = torch.isin(number, chosen)
    return demonstrations[~validation], demonstrations[validation]


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
) -> SequenceReplayBuffer:
    """Puts trajectories into a memory-mapped buffer that gives slices of them, ``[num_slices, slice_len]``.

    An epoch takes one slice from every trajectory, from a random place in it; a slice never spans two trajectories,
    and its first step has ``is_init`` set. Slices of the trajectories' own length see each step equally often and
    start as a trial does; the ends of longer trajectories are seen less.

    Only ``keys`` and the trajectories' ends are stored: ground-truth labels under ``info`` cannot reach training.

    Args:
        demonstrations: trajectories one after the other, ``[N]``, with ``("next", "done")``.
        slice_len: steps T a slice.
        num_slices: slices B a batch; an epoch's last, smaller batch is dropped.
        seed: of the order and the places.
        keys: the entries to store.
        scratch_dir: folder of the memory map. Default: a temporary one.

    Returns:
        The buffer; ``sample()`` gives ``[B, T]``.

    Raises:
        ValueError: if a trajectory is shorter than a slice, there are fewer of them than slices in a batch, or an entry
            is not finite.
        KeyError: if an entry is missing.

    Examples:
        >>> from tensordict import TensorDict
        >>> data = TensorDict({"observation": torch.zeros(8, 3), "action": torch.zeros(8, 2)}, [8])
        >>> data["is_init"] = (torch.arange(8) % 4 == 0)[:, None]
        >>> data["next"] = TensorDict({"observation": torch.zeros(8, 3), "done": data["is_init"].roll(-1, 0)}, [8])
        >>> make_sequence_buffer(data, slice_len=4, num_slices=2).sample()["action"].shape
        torch.Size([2, 4, 2])
    """
    stored = [*keys, *(key for key in _ENDS if key in demonstrations.keys(True) and key not in keys)]
    for key in [*stored, ("next", "done")]:
        value = demonstrations.get(key, None)
        if value is None:
            raise KeyError(f"the demonstrations have no {key!r}, only {sorted(map(str, demonstrations.keys(True)))}")
        bad = (~value.isfinite().flatten(1).all(1)).nonzero()[:, 0].tolist()
        if bad:
            raise ValueError(f"{key!r} is NaN or infinite in {len(bad)} rows, first {bad[:5]}: remove their trajectory")
    ends = demonstrations["next", "done"].reshape(-1).nonzero()[:, 0] + 1
    if not len(ends) or ends[-1] != len(demonstrations):
        raise ValueError("the last trajectory has no end: set ('next', 'done') at its last step")
    shortest = int(torch.diff(ends, prepend=ends.new_zeros(1)).min())
    if min(slice_len, num_slices) < 1 or shortest < slice_len or len(ends) < num_slices:
        raise ValueError(
            f"{len(ends)} trajectories of at least {shortest} steps do not give {num_slices} slices of {slice_len}: "
            "lower num_slices or slice_len"
        )
    buffer = SequenceReplayBuffer(
        storage=LazyMemmapStorage(len(demonstrations), scratch_dir=scratch_dir),
        sampler=SliceSamplerWithoutReplacement(slice_len=slice_len, end_key=("next", "done"), drop_last=True),
        batch_size=slice_len * num_slices,
        slice_len=slice_len,
    )
    buffer.set_rng(torch.Generator().manual_seed(seed))
    buffer.extend(demonstrations.select(*stored).clone())
    return buffer
