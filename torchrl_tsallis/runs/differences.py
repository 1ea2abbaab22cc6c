"""How modes of behaviour differ: where in the episodes, and in which dimensions of the action."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_tsallis.data.episodes import Episodes
from torchrl_tsallis.data.robust_scaling import RobustScaling
from torchrl_tsallis.runs.members import Split, train_members

#: Parts of an episode, and the largest modes that are compared.
PARTS, MOST_COMPARED = 10, 4


def parts_of_episodes(episodes: Episodes, parts: int = PARTS) -> Tensor:
    """Which part of its episode each row is in, ``[N]``; the last is shorter where the steps do not divide.

    Examples:
        >>> parts_of_episodes(Episodes(torch.tensor([0, 4]), torch.tensor([4, 2])), parts=2).tolist()
        [0, 0, 1, 1, 0, 1]
    """
    row = torch.arange(int(episodes.lengths.sum()))
    number = episodes.of_rows()
    return (row - episodes.starts[number]) * parts // episodes.lengths[number]


def differences(means: Tensor, own: Tensor, part: Tensor, scale: Tensor, parts: int = PARTS) -> Tensor:
    r"""Mean distance between what two modes' policies would do, on the demonstrations of either.

    .. math:: D_{abtd} = \frac{1}{|R_{abt}|} \sum_{i \in R_{abt}} |\mu_{aid} - \mu_{bid}| / s_d

    where R holds the rows of part t of the episodes of mode a or b.

    Args:
        means: mean action of each mode's policy at each row, ``[K, N, A]``.
        own: number of each row's mode, ``[N]``; rows of other modes have another number.
        part: of its episode each row is in, ``[N]``.
        scale: of the actions, ``[A]``.
        parts: how many.

    Returns:
        ``[K, K, parts, A]``; 0 where a pair has no row in a part.

    Examples:
        >>> means = torch.tensor([[[0.0], [2.0]], [[1.0], [6.0]]])
        >>> differences(means, torch.tensor([0, 1]), torch.tensor([0, 1]), torch.tensor([2.0]), parts=2)[0, 1]
        tensor([[0.5000],
                [2.0000]])
    """
    count = len(means)
    out = torch.zeros(count, count, parts, means.shape[-1])
    for a in range(count):
        for b in range(a + 1, count):
            rows = ((own == a) | (own == b)).nonzero().squeeze(1)
            apart = (means[a, rows] - means[b, rows]).abs() / scale
            total = torch.zeros(parts, means.shape[-1]).index_add_(0, part[rows], apart)
            seen = torch.zeros(parts).index_add_(0, part[rows], torch.ones(len(rows))).clamp_min(1)
            out[a, b] = out[b, a] = total / seen[:, None]
    return out


def mode_differences(
    data: TensorDictBase,
    groups: Sequence[Sequence[int]],
    episodes: Episodes,
    *,
    steps: int,
    batch_size: int = 256,
    seed: int = 0,
    device: str | torch.device = "cpu",
    progress: bool = False,
) -> tuple[list[int], Tensor]:
    """Trains a policy of each of the largest modes, and compares them.

    Args:
        data: ``observation`` ``[N, O]`` and ``action`` ``[N, A]``.
        groups: episodes of each mode.
        episodes: where they are.
        steps: gradient steps of a policy.
        batch_size: samples a step and policy.
        seed: of the policies.
        device: of the policies.
        progress: whether to show a bar.

    Returns:
        The modes that are compared, at most four of more than one episode, and their :func:`differences` in robust
        deviations of all actions; no mode where there are no two.
    """
    compared = [k for k, group in enumerate(groups) if len(group) > 1][:MOST_COMPARED]
    action_dim = data["action"].shape[1]
    if len(compared) < 2:
        return [], torch.zeros(0, 0, PARTS, action_dim)
    mode = torch.full((len(episodes.starts),), len(compared))
    for number, k in enumerate(compared):
        mode[list(groups[k])] = number
    own = mode[episodes.of_rows()]
    splits = [Split(seed, own != number) for number in range(len(compared))]
    members = train_members(data, splits, steps=steps, batch_size=batch_size, device=device, progress=progress)
    scale = RobustScaling.fit(data.select("observation", "action")).scales["action"].float()
    return compared, differences(members.means(data), own, parts_of_episodes(episodes), scale)
