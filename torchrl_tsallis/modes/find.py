"""From demonstrations to their modes: by the distributions of what happens in them, or by mixtures of policies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, get_args

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_tsallis._checks import check_flag, check_number
from torchrl_tsallis._device import check_device
from torchrl_tsallis.data.episodes import find_episodes
from torchrl_tsallis.data.robust_scaling import RobustScaling
from torchrl_tsallis.data.schema import check_rows
from torchrl_tsallis.modes.consensus import together
from torchrl_tsallis.modes.distributions import areas_between, behaviour, distribution_functions
from torchrl_tsallis.modes.found import TOGETHER, By, Modes
from torchrl_tsallis.modes.train import train_mixtures

#: Updates of the responsibilities.
UPDATES = 60
#: Largest seed: others are made of it by sums and products.
MOST_SEED = 10**12
#: Most components and starts, each: more would not fit into a program.
MOST_MEMBERS = 1000
#: Most episodes that are compared each with each.
MOST_EPISODES = 3000
KEYS = ("observation", "action")


def find_modes(
    data: TensorDictBase,
    *,
    by: By = "distributions",
    components: int | None = None,
    starts: int = 4,
    batch_size: int = 256,
    seed: int = 0,
    updates: int = UPDATES,
    threshold: float = 0.5,
    always: bool = False,
    device: str | torch.device = "cpu",
    progress: bool = False,
) -> Modes:
    """Finds modes of behaviour, whose units are whole episodes, without labels.

    By **distributions** (seconds, nothing is random): modes are groups of episodes that lie apart, by how differently
    observations, actions and their changes are distributed (:mod:`~torchrl_tsallis.modes.distributions`,
    :mod:`~torchrl_tsallis.modes.separation`). Where no split has a mean silhouette of ``threshold``, there is one mode.

    By **policies** (minutes): mixtures are started several times, every second time with a third of the components
    less. Modes are groups of episodes that are of one component in most starts
    (:mod:`~torchrl_tsallis.modes.consensus`): components that share a behaviour, and divide its episodes in one way
    here and in another there, become one mode by that. Where the starts agree by no more than chance would let them (an
    adjusted Rand index under 0.2), there is one mode. This sees demonstrators who do other things in the same
    situations although, over an episode, they do each as often.

    The same in other units, up to rounding. What neither can see: demonstrators who act alike, and an operator who
    changes within an episode.

    Args:
        data: ``observation`` ``[N, O]``, ``action`` ``[N, A]``, with episodes.
        by: what modes are found by.
        components: by distributions the number of modes, whether they lie apart or not; by policies the components of a
            mixture, an upper bound of the number of large modes, of which at most a third of the episodes are taken.
            Default: as many as there are; 6.
        starts: of mixtures; by policies, as are the next three.
        batch_size: samples a step and component.
        seed: of the starts and the policies.
        updates: of the responsibilities, an epoch between two.
        threshold: least mean silhouette of a split, or least share of starts in which the episodes of a mode are
            together.
        always: whether modes are what the starts agree on, however little that is.
        device: of the policies.
        progress: whether to show a bar.

    Returns:
        The modes.

    Raises:
        ValueError: if there are fewer than six episodes, or more than 3000 by distributions, the data are pairs without
            episodes, or a number is outside of its range.

    Examples:
        >>> from tensordict import TensorDict
        >>> place = (torch.arange(12) % 2).repeat_interleave(10)[:, None] + 0.1 * torch.rand(120, 1)
        >>> data = TensorDict({"observation": place, "action": -place}, [120])
        >>> find_modes(data.set("episode", torch.arange(120) // 10)).groups
        ((0, 2, 4, 6, 8, 10), (1, 3, 5, 7, 9, 11))
    """
    if by not in get_args(By):
        raise ValueError(f"by={by!r}: choose of {', '.join(get_args(By))}")
    if by == "policies":
        options: dict[str, Any] = {"components": 6 if components is None else components, "starts": starts}
        options |= {"batch_size": batch_size, "updates": updates, "device": device, "progress": progress}
        return find_modes_of_each([data], seeds=[seed], threshold=threshold, always=always, **options)[0]
    _check_training(starts, updates, batch_size, [seed])
    threshold = check_number("threshold", threshold, above=0, high=1)
    check_flag("always", always)
    check_flag("progress", progress)
    check_device(device)
    rows = _checked(data)
    number = rows["episode"]
    count = int(number[-1]) + 1
    if components is not None:
        components = int(check_number("components", components, low=2, high=count, integer=True))
    elif always:
        raise ValueError("always=True without components: say how many modes there are")
    if count > MOST_EPISODES:
        raise ValueError(
            f"{count} episodes are too many to compare each with each, the limit is {MOST_EPISODES}: choose a "
            "subset of them, or find modes by policies"
        )
    functions = distribution_functions(behaviour(rows, number), number, count)
    return Modes.of_distances(areas_between(functions), least=threshold, count=components)


def _check_training(
    starts: Any, updates: Any, batch_size: Any, seeds: Sequence[Any]
) -> tuple[int, int, int, list[int]]:
    whole = (
        check_number("starts", starts, low=2, high=MOST_MEMBERS, integer=True),
        check_number("updates", updates, low=1, integer=True),
        check_number("batch_size", batch_size, low=1, integer=True),
    )
    starts, updates, batch_size = map(int, whole)
    given = [int(check_number("seed", seed, low=0, high=MOST_SEED, integer=True)) for seed in seeds]
    return starts, updates, batch_size, given


def _checked(data: TensorDictBase) -> TensorDictBase:
    """Observations, actions and numbers of the episodes of data that modes can be found among."""
    check_rows(data, KEYS)
    for key in KEYS:
        if not isinstance(data[key], Tensor) or data[key].ndim != 2 or not data[key].is_floating_point():
            raise ValueError(f"{key!r} is no vector of floating-point numbers [N, D]: modes are found among those")
    episodes = find_episodes(data, purpose="a search for modes", open_end=True)
    if len(episodes.starts) < 6:
        raise ValueError(f"{len(episodes.starts)} episodes are too few to find modes among them: record at least 6")
    return data.select(*KEYS).set("episode", episodes.of_rows())


def find_modes_of_each(
    sets: Sequence[TensorDictBase],
    *,
    seeds: Sequence[int],
    components: int = 6,
    starts: int = 4,
    batch_size: int = 256,
    updates: int = UPDATES,
    threshold: float = TOGETHER,
    always: bool = False,
    device: str | torch.device = "cpu",
    progress: bool = False,
) -> list[Modes]:
    """:func:`find_modes` by policies, of several sets that have nothing in common, as one program; it pays on a GPU.

    What is found is the same as in one set after the other, up to rounding, where the sets are equally long.

    Args:
        sets: of demonstrations of the same robot, ``[N]`` each.
        seeds: one a set.
        components: of a mixture; at most a third of the episodes of the smallest set are taken.
        starts: of mixtures of each set.
        batch_size: samples a step and component.
        updates: of the responsibilities, an epoch between two.
        threshold: least share of starts in which the episodes of a mode are together.
        always: whether modes are what the starts agree on, however little that is.
        device: of the policies.
        progress: whether to show a bar.

    Returns:
        The modes of each set.

    Raises:
        ValueError: as for :func:`find_modes`, or if there is not a seed a set.
    """
    components = int(check_number("components", components, low=2, high=MOST_MEMBERS, integer=True))
    starts, updates, batch_size, seeds = _check_training(starts, updates, batch_size, seeds)
    threshold = check_number("threshold", threshold, above=0, high=1)
    check_flag("always", always)
    check_flag("progress", progress)
    check_device(device)
    if not len(sets) or len(seeds) != len(sets):
        raise ValueError(f"{len(sets)} sets and {len(seeds)} seeds: give one seed a set, and at least one")
    scaled, counts = [], []
    for data in sets:
        rows = _checked(data)
        counts.append(int(rows["episode"][-1]) + 1)
        scaled.append(RobustScaling.fit(rows.select(*KEYS))(rows.select(*KEYS)).set("episode", rows["episode"]))
    components = min(components, min(counts) // 3)
    sizes = [components if k % 2 == 0 else max(2, 2 * components // 3) for k in range(starts)]
    mixture = train_mixtures(
        scaled, sizes, seeds=seeds, updates=updates, batch_size=batch_size, device=device, progress=progress
    )
    out = []
    of_sets = zip(mixture.responsibilities.split(sum(sizes)), mixture.known[::starts], strict=True)
    for responsibilities, own in of_sets:
        found = [part[:, own] for part in responsibilities.split(sizes)]
        pairs = together(found)
        starts_of = torch.stack([part.argmax(0) for part in found])
        out.append(Modes.of_starts(pairs, starts_of, threshold=threshold, always=always))
    return out
