"""Simple signals of a demonstration's quality, which stand beside a rating: no policy is trained.

Each is a function of the data alone, of vectors that were scaled before (see
:class:`~torchrl_tsallis.data.RobustScaling`), so that none depends on a unit. None of them says whether an episode is
good; each docstring says what it can see.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_tsallis.data.episodes import Episodes, find_episodes
from torchrl_tsallis.data.robust_scaling import RobustScaling

#: Rows of which neighbours are looked for; of longer data so many, drawn with a seed.
SAMPLE = 8192
#: Rows among which mutual information is estimated together.
GROUP = 1024


def _mean_of(values: Tensor, episodes: Episodes) -> Tensor:
    """Mean of ``[N]`` over each episode, ``[E]`` float64."""
    total = torch.zeros(len(episodes.starts), dtype=torch.float64, device=values.device)
    return total.index_add_(0, episodes.of_rows(), values.double()) / episodes.lengths


def knn_residual(
    observation: Tensor, action: Tensor, episodes: Episodes, *, k: int = 5, sample: int = SAMPLE, seed: int = 0
) -> Tensor:
    """Distance of each action from the mean action of the k nearest observations of other episodes, a dimension.

    Sees actions that others did not take in similar states, like the policy's surprise, without a policy. Does not see
    what is wrong in states that nobody else visits (their neighbours are far, and their actions mean little), takes
    different good solutions for errors, and grows blind with the number of observation dimensions.

    Args:
        observation: scaled, ``[N, O]``.
        action: scaled, ``[N, A]``.
        episodes: of the rows; at least two.
        k: neighbours.
        sample: rows among which they are looked for, drawn where there are more.
        seed: of the draw.

    Returns:
        Root mean square over the dimensions, ``[N]``; NaN where there is no other episode.

    Examples:
        >>> x, a = torch.tensor([[0.0], [1.0], [0.0], [1.0]]), torch.tensor([[0.0], [0.0], [0.0], [2.0]])
        >>> knn_residual(x, a, Episodes(torch.tensor([0, 2]), torch.tensor([2, 2])), k=1)
        tensor([0., 2., 0., 2.])
    """
    of_rows, size = episodes.of_rows(), len(observation)
    known = torch.arange(size)
    if size > sample:
        known = torch.randperm(size, generator=torch.Generator().manual_seed(seed))[:sample].sort().values
    out = torch.full((size,), torch.nan)
    x, a, number = observation[known].float(), action[known].float(), of_rows[known]
    step = max(1, 2**22 // max(1, len(known)))
    for start in range(0, size, step):
        part = slice(start, min(size, start + step))
        away = torch.cdist(observation[part].float(), x)
        away = away.masked_fill(of_rows[part][:, None] == number, torch.inf)
        distance, index = away.topk(min(k, len(known)), largest=False)
        valid = distance.isfinite().float()
        mean = (a[index] * valid[..., None]).sum(1) / valid.sum(1, keepdim=True)
        out[part] = (action[part] - mean).square().mean(1).sqrt()
    return out


def mutual_information(
    observation: Tensor, action: Tensor, *, k: int = 5, group: int = GROUP, rounds: int = 4, seed: int = 0
) -> Tensor:
    r"""What each row adds to the mutual information of state and action, in nats.

    .. math:: \psi(k) + \psi(n) - \psi(n_s + 1) - \psi(n_a + 1)

    with the numbers of rows whose state, or action, is nearer than the k-th neighbour in both. Sees episodes whose
    actions follow from their states less than those of others (noise, hesitation), and states of little variety. Does
    not see a consistently wrong action, which is as predictable as a right one; single rows are noisy, and many
    dimensions need many rows.

    Source: Kraskov, Stoegbauer & Grassberger, Phys. Rev. E 2004 (KSG); Hejna et al., "Robot Data Curation with Mutual
    Information Estimators", RSS 2025 (DemInf, which takes the mean over an episode).

    Args:
        observation: scaled, ``[N, O]``.
        action: scaled, ``[N, A]``.
        k: neighbours.
        group: rows that are looked at together, drawn at random.
        rounds: groups that each row is in; their mean is taken.
        seed: of the groups.

    Returns:
        The contributions, ``[N]``; their mean estimates the mutual information. NaN with no more than k rows.

    Examples:
        >>> x = torch.randn(500, 1, generator=torch.Generator().manual_seed(0))
        >>> bool(mutual_information(x, x + 0.1 * x.flip(0)).mean() > 1 > mutual_information(x, x.flip(0)).mean() + 0.5)
        True
    """
    size = len(observation)
    out = torch.zeros(size, dtype=torch.float64)
    if size <= k:
        return out.fill_(torch.nan)
    generator = torch.Generator().manual_seed(seed)
    for _ in range(rounds):
        for rows in torch.randperm(size, generator=generator).tensor_split(-(-size // max(group, k + 1))):
            s, a = (torch.cdist(v, v) for v in (observation[rows].double(), action[rows].double()))
            for away in (s, a):
                away.fill_diagonal_(torch.inf)
            limit = torch.maximum(s, a).kthvalue(k, dim=1, keepdim=True).values
            near = sum(torch.digamma((away < limit).sum(1).double() + 1) for away in (s, a))
            first, last = torch.tensor([float(k), float(len(rows))], dtype=torch.float64).digamma()
            out[rows] += (first + last - near) / rounds
    return out


def jerk(action: Tensor, episodes: Episodes) -> Tensor:
    """Median size of the third difference of an episode's actions, a dimension.

    Sees shaking, and a recording whose values jump. Does not see smooth mistakes; quick and right motions have more of
    it than slow ones, and where actions are velocities or torques it is not the jerk of physics.

    Args:
        action: scaled, ``[N, A]``.
        episodes: of the rows.

    Returns:
        ``[E]``; NaN for episodes of less than four steps.

    Examples:
        >>> jerk(torch.tensor([[0.0], [0.0], [0.0], [1.0]]), Episodes(torch.tensor([0]), torch.tensor([4])))
        tensor([1.], dtype=torch.float64)
    """

    def one(rows: Tensor) -> Tensor:
        return rows.diff(n=3, dim=0).square().mean(1).sqrt().median()

    return _each(one, action, episodes, least=4)


def path_length(observation: Tensor, episodes: Episodes) -> Tensor:
    """Sum of an episode's changes of the observation.

    Sees detours, repeated attempts and unfinished episodes. Does not see how anything was done; other starting places
    and tasks of several sizes change it without any fault.

    Args:
        observation: scaled, ``[N, O]``.
        episodes: of the rows.

    Returns:
        ``[E]``; 0 for an episode of one step.

    Examples:
        >>> path_length(torch.tensor([[0.0], [3.0], [1.0]]), Episodes(torch.tensor([0]), torch.tensor([3])))
        tensor([5.], dtype=torch.float64)
    """

    def one(rows: Tensor) -> Tensor:
        return torch.linalg.vector_norm(rows.diff(dim=0), dim=1).sum()

    return _each(one, observation, episodes, least=1)


def still_share(observation: Tensor, episodes: Episodes, *, tolerance: float = 1e-3) -> Tensor:
    """Share of an episode's steps after which no dimension of the observation has changed.

    Sees waiting, a frozen sensor, and a recording that went on after the end. Does not see hesitation in motion, and
    takes waiting that belongs to the task for a fault; sensor noise over the tolerance hides it.

    Args:
        observation: scaled, ``[N, O]``.
        episodes: of the rows.
        tolerance: greatest change, in robust standard deviations (0.001).

    Returns:
        ``[E]``; NaN for episodes of one step.

    Examples:
        >>> still_share(torch.tensor([[0.0], [0.0], [1.0]]), Episodes(torch.tensor([0]), torch.tensor([3])))
        tensor([0.5000], dtype=torch.float64)
    """

    def one(rows: Tensor) -> Tensor:
        return (rows.diff(dim=0).abs().amax(1) <= tolerance).double().mean()

    return _each(one, observation, episodes, least=2)


def _each(function: Callable[[Tensor], Tensor], values: Tensor, episodes: Episodes, *, least: int) -> Tensor:
    """A function of the rows of each episode, ``[E]``; NaN for those with fewer rows than it needs."""
    out = torch.full((len(episodes.starts),), torch.nan, dtype=torch.float64)
    for number, (start, length) in enumerate(zip(episodes.starts.tolist(), episodes.lengths.tolist(), strict=True)):
        if length >= least:
            out[number] = function(values[start : start + length].double())
    return out


def episode_signals(demonstrations: TensorDictBase, *, seed: int = 0) -> dict[str, Tensor]:
    """All signals of each episode.

    Length (``steps``) sees episodes that were broken off or took long, and nothing else; it is often the best of all.
    The others are the functions of this module, of data that is scaled by itself.

    Args:
        demonstrations: ``observation`` ``[N, O]``, ``action`` ``[N, A]``, and episodes.
        seed: of what is drawn.

    Returns:
        ``knn_residual``, ``deminf``, ``jerk``, ``path_length``, ``still_share`` and ``steps``, each ``[E]``.

    Examples:
        >>> from tensordict import TensorDict
        >>> rows = {"observation": torch.rand(8, 2), "action": torch.rand(8, 1), "episode": torch.arange(8) // 4}
        >>> sorted(episode_signals(TensorDict(rows, [8])))
        ['deminf', 'jerk', 'knn_residual', 'path_length', 'steps', 'still_share']
    """
    episodes = find_episodes(demonstrations, purpose="signals of episodes", open_end=True)
    scaled = RobustScaling.fit(demonstrations)(demonstrations.select("observation", "action"))
    observation, action = scaled["observation"], scaled["action"]
    return {
        "steps": episodes.lengths,
        "knn_residual": _mean_of(knn_residual(observation, action, episodes, seed=seed), episodes),
        "deminf": _mean_of(mutual_information(observation, action, seed=seed), episodes),
        "jerk": jerk(action, episodes),
        "path_length": path_length(observation, episodes),
        "still_share": still_share(observation, episodes),
    }
