"""Splits of demonstrations by whole episodes: steps of one episode are too alike to stand on both sides."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_tsallis._checks import check_number, check_seed, shown
from torchrl_tsallis.data.episodes import find_episodes
from torchrl_tsallis.data.rows import take_rows


def split_episodes(demonstrations: TensorDictBase, share: float, *, seed: int = 0) -> tuple[Any, Any]:
    """Splits demonstrations into training and validation by whole trajectories.

    Args:
        demonstrations: trajectories one after the other, ``[N]``, see :mod:`torchrl_tsallis.data.schema`.
        share: of the trajectories that are kept for validation, in (0, 1); at least one.
        seed: of the choice.

    Returns:
        Training and validation data, ``[N1]`` and ``[N2]``, in the recorded order.

    Raises:
        ValueError: if a side would be empty, or it cannot be told where trajectories end.

    Examples:
        >>> from tensordict import TensorDict
        >>> done = torch.tensor([False, True, False, True])[:, None]
        >>> data = TensorDict({"next": {"done": done}, "x": torch.arange(4)}, [4])
        >>> sorted(len(part) for part in split_episodes(data, 0.5))
        [2, 2]
    """
    share, seed = check_number("share", share), check_seed("seed", seed)
    episodes = find_episodes(demonstrations, purpose="a split by trajectories")
    count = len(episodes.starts)
    held_out = max(1, round(share * count)) if 0 < share < 1 else count
    if held_out >= count:
        raise ValueError(f"a share of {share} of {count} trajectories leaves nothing on one side")
    chosen = torch.randperm(count, generator=torch.Generator().manual_seed(seed))[:held_out]
    validation = torch.isin(episodes.of_rows(), chosen)
    return take_rows(demonstrations, ~validation), take_rows(demonstrations, validation)


#: The same under the name that trajectories had first.
split_trajectories = split_episodes


def fold_episodes(demonstrations: TensorDictBase, folds: int, *, seed: int = 0) -> list[Tensor]:
    """Deals the episodes into folds, so that each can be rated by policies that did not see it.

    Args:
        demonstrations: episodes one after the other, ``[N]``.
        folds: k, at least 2 and at most the number of episodes. Their numbers of episodes differ by one at most.
        seed: of the order in which they are dealt.

    Returns:
        k masks ``[N]`` of the rows that are held out; each row is in exactly one.

    Raises:
        ValueError: if there are fewer episodes than folds, or it cannot be told where they end.

    Examples:
        >>> from tensordict import TensorDict
        >>> data = TensorDict({"episode": torch.tensor([0, 0, 1, 2])}, [4])
        >>> torch.stack(fold_episodes(data, 3)).sum(0)
        tensor([1, 1, 1, 1])
    """
    seed = check_seed("seed", seed)
    episodes = find_episodes(demonstrations, purpose="a split into folds")
    count = len(episodes.starts)
    if isinstance(folds, bool) or not isinstance(folds, int) or not 2 <= folds <= count:
        raise ValueError(
            f"{shown(folds)} folds of {count} episodes: give a whole number from 2 to the number of episodes"
        )
    order = torch.randperm(count, generator=torch.Generator().manual_seed(seed))
    fold = torch.empty(count, dtype=torch.int64)
    fold[order] = torch.arange(count) % folds
    of_rows = fold[episodes.of_rows()]
    return [of_rows == k for k in range(folds)]
