"""The noises of section V-A as pure functions of demonstrations, with ground-truth labels kept beside the data.

Demonstrations are a flat TensorDict ``[N]`` with ``observation`` and ``action``, and side entries under ``info`` that
training never reads: ``episode``, ``expert``, ``is_noise`` and ``is_amateur``, each ``[N]``.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_tsallis._checks import check_number, check_seed, shown
from torchrl_tsallis.data.schema import check_rows, leaves

#: The most that a float32 action may be moved by.
LARGEST = 1e30
#: Task -> (artificial noise, amateur), section V-A.
TASKS = {
    "clean": (False, False),
    "artificial": (True, False),
    "amateur": (False, True),
    "both": (True, True),
}


def _rows_with(data: TensorDictBase, name: str, key: NestedKey) -> Tensor:
    """An entry of flat demonstrations that have rows; the message of what is missing names argument and key."""
    if not isinstance(data, TensorDictBase) or data.ndim != 1 or not len(data):
        got = f"the batch size {list(data.shape)}" if isinstance(data, TensorDictBase) else f"a {type(data).__name__}"
        raise TypeError(f"{name} must be demonstrations, a TensorDict of N rows, got {got}")
    return leaves(data, [key])[key]


def _layout(data: TensorDictBase, dtypes: bool) -> dict[NestedKey, str]:
    """Shape, and perhaps dtype, of each entry's rows."""
    found = {key: value for key, value in data.items(True, True) if isinstance(value, Tensor)}
    return {key: f"{list(x.shape[1:])}{f' of {x.dtype}' * dtypes}" for key, x in found.items()}


def _check_alike(experts: TensorDictBase, others: TensorDictBase, name: str, *, dtypes: bool = False) -> None:
    """Raises for rows of another layout, which cannot stand in the experts' place."""
    own, other = _layout(experts, dtypes), _layout(others, dtypes)
    for key in own.keys() | other.keys():
        if own.get(key) != other.get(key):
            raise ValueError(
                f"{key!r} of the demonstrations is {own.get(key, 'missing')} in experts and "
                f"{other.get(key, 'missing')} in {name}: both need the same entries"
            )


def add_action_noise(
    demonstrations: TensorDictBase, *, probability: float = 0.1, mean: float = 5.0, scale: float = 1.0, seed: int = 0
) -> TensorDict:
    """Adds N(mean, scale) to every dimension of the action of randomly chosen time steps.

    Args:
        demonstrations: flat ``[N]``; not changed.
        probability: chance of a time step to be hit (0.1, section V-A).
        mean: mean of the noise, in units of the action (5, section V-A).
        scale: its standard deviation (1, section V-A).
        seed: of the noise.

    Returns:
        A copy with the noise, and ``("info", "is_noise")``, ``[N]`` bool, set where it was added.

    Raises:
        ValueError: if the probability is not in [0, 1] or the scale is negative.

    Examples:
        >>> data = TensorDict({"action": torch.zeros(4, 2), "info": TensorDict({}, [4])}, [4])
        >>> noisy = add_action_noise(data, probability=0.5, scale=0.0, seed=1)
        >>> torch.equal(noisy["action"][:, 0], 5.0 * noisy["info", "is_noise"])
        True
    """
    probability = check_number("probability", probability, low=0, high=1)
    mean = float(check_number("mean", mean, low=-LARGEST, high=LARGEST))
    scale = float(check_number("scale", scale, low=0, high=LARGEST))
    generator = torch.Generator().manual_seed(check_seed("seed", seed))
    action = _rows_with(demonstrations, "demonstrations", "action")
    if not action.is_floating_point() or action.ndim != 2:
        raise TypeError(
            f"'action' is {action.dtype} of shape {list(action.shape)}: noise needs vectors of real numbers"
        )
    hit = torch.rand(action.shape[:1], generator=generator) < probability
    noise = mean + scale * torch.randn(action.shape, generator=generator, dtype=action.dtype)
    out = demonstrations.clone()
    out["action"] = torch.where(hit.unsqueeze(-1), action + noise, action)
    out["info", "is_noise"] = hit
    return out


def replace_with_amateur(
    experts: TensorDictBase, amateur: TensorDictBase, *, per_expert: int = 1, seed: int = 0
) -> TensorDict:
    """Replaces randomly chosen trajectories of each expert by trajectories of an amateur (section V-A).

    Args:
        experts: demonstrations ``[N]`` of any number of experts; not changed.
        amateur: demonstrations ``[M]`` of the amateur, at least ``per_expert`` trajectories for each expert.
        per_expert: number of trajectories of each expert that are replaced (1, section V-A).
        seed: of the choice.

    Returns:
        A copy in which the chosen trajectories are the amateur's, under the replaced ones' ``episode`` and ``expert``,
        with ``("info", "is_amateur")`` set.

    Raises:
        ValueError: if there are too few trajectories, or a number of a trajectory stands in two runs of rows.

    Examples:
        >>> def rows(n):
        ...     info = {"episode": torch.arange(n), "expert": torch.zeros(n, dtype=torch.int64)}
        ...     info |= {"is_amateur": torch.zeros(n, dtype=torch.bool)}
        ...     return TensorDict({"action": torch.zeros(n, 1), "info": TensorDict(info, [n])}, [n])
        >>> replace_with_amateur(rows(4), rows(1))["info", "is_amateur"].sum()
        tensor(1)
    """
    per_expert = int(check_number("per_expert", per_expert, low=0, integer=True))
    _rows_with(experts, "experts", ("info", "expert"))
    for name, side in (("experts", experts), ("amateur", amateur)):
        runs = _rows_with(side, name, ("info", "episode")).unique_consecutive()
        numbers, counts = runs.unique(return_counts=True)
        if (counts > 1).any():
            raise ValueError(
                f"trajectory {numbers[counts > 1][0].item()} of the {name} stands in two runs of rows, and its rows "
                "would be taken twice: give each trajectory a number of its own under ('info', 'episode')"
            )
        check_rows(side, [("info", "episode")])
    check_rows(experts, [("info", "expert")])
    _check_alike(experts, amateur, "amateur")
    generator = torch.Generator().manual_seed(check_seed("seed", seed))
    spare = amateur["info", "episode"].unique().tolist()
    replaced: dict[int, int] = {}
    for expert in experts["info", "expert"].unique().tolist():
        own = experts["info", "episode"][experts["info", "expert"] == expert].unique()
        if len(own) < per_expert or len(spare) < per_expert:
            raise ValueError(
                f"expert {expert} has {len(own)} trajectories and {len(spare)} of the amateur's are left, "
                f"per_expert={per_expert} of each are needed: record more, or replace fewer"
            )
        for index in torch.randperm(len(own), generator=generator)[:per_expert].tolist():
            replaced[int(own[index])] = spare.pop(0)
    parts = []
    for episode in experts["info", "episode"].unique_consecutive().tolist():
        part = experts[experts["info", "episode"] == episode]
        if episode in replaced:
            other = amateur[amateur["info", "episode"] == replaced[episode]].clone()
            other["info", "is_amateur"] = torch.ones(len(other), dtype=torch.bool)
            for key in ("episode", "expert"):
                other["info", key] = part["info", key][:1].expand(len(other)).clone()
            part = other
        parts.append(part)
    return torch.cat(parts)


def make_task(
    task: str,
    experts: TensorDictBase,
    amateur: TensorDictBase,
    *,
    seed: int = 0,
    probability: float = 0.1,
    mean: float = 5.0,
    scale: float = 1.0,
) -> TensorDict:
    """Builds the demonstrations of one of the paper's four tasks.

    Args:
        task: ``"clean"``, ``"artificial"``, ``"amateur"`` or ``"both"``.
        experts: the experts' demonstrations, ``[N]``.
        amateur: the amateur's, ``[M]``.
        seed: of the corruptions.
        probability: of the artificial noise.
        mean: of the artificial noise.
        scale: of the artificial noise.

    Returns:
        The demonstrations, ``[N]``.

    Raises:
        ValueError: if there is no such task.

    Examples:
        >>> make_task("noisy", TensorDict({}, [1]), TensorDict({}, [1]))
        Traceback (most recent call last):
        ...
        ValueError: no task 'noisy': choose one of clean, artificial, amateur, both
    """
    if not isinstance(task, str) or task not in TASKS:
        raise ValueError(f"no task {shown(task)}: choose one of {', '.join(TASKS)}")
    probability = check_number("probability", probability, low=0, high=1)
    mean = float(check_number("mean", mean, low=-LARGEST, high=LARGEST))
    scale, seed = float(check_number("scale", scale, low=0, high=LARGEST)), check_seed("seed", seed)
    artificial, with_amateur = TASKS[task]
    out = replace_with_amateur(experts, amateur, seed=seed) if with_amateur else experts.clone()
    if artificial:
        out = add_action_noise(out, probability=probability, mean=mean, scale=scale, seed=seed)
    return out


def replace_pairs(experts: TensorDictBase, others: TensorDictBase, *, share: float, seed: int = 0) -> TensorDict:
    """Replaces randomly chosen pairs, one by one, by pairs of other demonstrators: samples that contradict each other.

    Args:
        experts: demonstrations ``[N]``; not changed.
        others: of whoever is worse, ``[M]``; a pair of theirs may be drawn more than once.
        share: chance of a pair to be replaced, in [0, 1].
        seed: of the choice.

    Returns:
        A copy in which ``("info", "is_amateur")`` is set where a pair was replaced. It is a set of pairs, since an
        episode holds observations of several now.

    Raises:
        ValueError: if the share is not in [0, 1].

    Examples:
        >>> def rows(value):
        ...     info = TensorDict({"is_amateur": torch.zeros(8, dtype=torch.bool)}, [8])
        ...     return TensorDict({"action": torch.full((8, 1), value), "info": info}, [8])
        >>> mixed = replace_pairs(rows(0.0), rows(1.0), share=0.5, seed=1)
        >>> torch.equal(mixed["action"][:, 0].bool(), mixed["info", "is_amateur"])
        True
    """
    share = check_number("share", share, low=0, high=1)
    generator = torch.Generator().manual_seed(check_seed("seed", seed))
    _rows_with(experts, "experts", ("info", "is_amateur"))
    check_rows(others, ["action"])
    pairs = experts.exclude("info")
    _check_alike(pairs, others.select(*pairs.keys(), strict=False), "others", dtypes=True)
    hit = torch.rand(experts.shape, generator=generator) < share
    drawn = torch.randint(len(others), (int(hit.sum()),), generator=generator)
    out = experts.clone()
    for key, value in out.items():
        if key != "info":
            value[hit] = others[key][drawn]
    out["info", "is_amateur"][hit] = True
    return out
