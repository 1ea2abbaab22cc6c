"""From demonstrations to their modes: starts of mixtures, and what they agree on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_tsallis._checks import check_flag, check_number
from torchrl_tsallis._device import check_device
from torchrl_tsallis.data.episodes import find_episodes
from torchrl_tsallis.data.robust_scaling import RobustScaling
from torchrl_tsallis.data.schema import check_rows
from torchrl_tsallis.modes.consensus import together
from torchrl_tsallis.modes.found import TOGETHER, Modes
from torchrl_tsallis.modes.train import train_mixtures

#: Updates of the responsibilities.
UPDATES = 60
#: Largest seed: others are made of it by sums and products.
MOST_SEED = 10**12
#: Most components and starts, each: more would not fit into a program.
MOST_MEMBERS = 1000
KEYS = ("observation", "action")


def find_modes(
    data: TensorDictBase,
    *,
    components: int = 6,
    starts: int = 4,
    batch_size: int = 256,
    seed: int = 0,
    updates: int = UPDATES,
    threshold: float = TOGETHER,
    always: bool = False,
    device: str | torch.device = "cpu",
    progress: bool = False,
) -> Modes:
    """Finds modes of behaviour, whose units are whole episodes, without labels.

    Mixtures are started several times, every second time with a third of the components less. Modes are groups of
    episodes that are of one component in most starts (:func:`~torchrl_tsallis.modes.consensus`): components that share
    a behaviour, and divide its episodes in one way here and in another there, become one mode by that. Where the
    starts agree by no more than chance would let them (an adjusted Rand index under 0.2), there is one mode.

    The number of components is an upper bound of the number of large modes. The same in other units, up to rounding.
    What this cannot see: demonstrators who act alike, and an operator who changes within an episode.

    Args:
        data: ``observation`` ``[N, O]``, ``action`` ``[N, A]``, with episodes.
        components: of a mixture; at most a third of the episodes are taken.
        starts: of mixtures.
        batch_size: samples a step and component.
        seed: of the starts and the policies.
        updates: of the responsibilities, an epoch between two.
        threshold: least share of starts in which the episodes of a mode are together.
        always: whether modes are what the starts agree on, however little that is.
        device: of the policies.
        progress: whether to show a bar.

    Returns:
        The modes.

    Raises:
        ValueError: if there are fewer than six episodes, the data are pairs without episodes, or a number is outside
            of its range.

    Examples:
        >>> from tensordict import TensorDict
        >>> data = TensorDict({"observation": torch.rand(120, 2), "action": torch.rand(120, 1)}, [120])
        >>> found = find_modes(data.set("episode", torch.arange(120) // 10), components=2, updates=3)
        >>> sum(map(len, found.groups))
        12
    """
    options: dict[str, Any] = {"components": components, "starts": starts, "batch_size": batch_size, "updates": updates}
    options |= {"threshold": threshold, "always": always, "device": device, "progress": progress}
    return find_modes_of_each([data], seeds=[seed], **options)[0]


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
    """:func:`find_modes` of several sets that have nothing in common, as one program, which pays on a GPU.

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
    components, starts = (int(check_number(name, value, low=2, high=MOST_MEMBERS, integer=True)) for name, value in
                          (("components", components), ("starts", starts)))  # fmt: skip
    updates = int(check_number("updates", updates, low=1, integer=True))
    batch_size = int(check_number("batch_size", batch_size, low=1, integer=True))
    seeds = [int(check_number("seed", seed, low=0, high=MOST_SEED, integer=True)) for seed in seeds]
    threshold = check_number("threshold", threshold, above=0, high=1)
    check_flag("always", always)
    check_flag("progress", progress)
    check_device(device)
    if not len(sets) or len(seeds) != len(sets):
        raise ValueError(f"{len(sets)} sets and {len(seeds)} seeds: give one seed a set, and at least one")
    scaled, counts = [], []
    for data in sets:
        check_rows(data, KEYS)
        for key in KEYS:
            if not isinstance(data[key], Tensor) or data[key].ndim != 2 or not data[key].is_floating_point():
                raise ValueError(f"{key!r} is no vector of floating-point numbers [N, D]: modes are found among those")
        episodes = find_episodes(data, purpose="a search for modes", open_end=True)
        counts.append(len(episodes.starts))
        if counts[-1] < 6:
            raise ValueError(f"{counts[-1]} episodes are too few to find modes among them: record at least 6")
        rows = data.select(*KEYS)
        scaled.append(RobustScaling.fit(rows)(rows).set("episode", episodes.of_rows()))
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
        out.append(Modes.of(pairs, starts_of, threshold=threshold, always=always))
    return out
