"""From demonstrations to their modes: starts of mixtures, and what they agree on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_tsallis._checks import check_number
from torchrl_tsallis.data.episodes import find_episodes
from torchrl_tsallis.data.robust_scaling import RobustScaling
from torchrl_tsallis.modes.consensus import consensus, together
from torchrl_tsallis.modes.found import Modes
from torchrl_tsallis.modes.mixture import EpisodeMixture
from torchrl_tsallis.modes.responsibilities import Annealing
from torchrl_tsallis.modes.sampler import make_episode_buffer
from torchrl_tsallis.modules.policy import make_policy
from torchrl_tsallis.objectives.bc import TsallisBCLoss
from torchrl_tsallis.optim.adaterm import AdaTerm
from torchrl_tsallis.ratings.peak import PeakRating
from torchrl_tsallis.ratings.score_tuner import ScoreTuner
from torchrl_tsallis.trainers.hooks import undisturbed
from torchrl_tsallis.trainers.offline import make_offline_trainer

#: Power of the scale-weighted likelihood, and the size of AdaTerm's steps, as where single policies are trained.
BETA, LR = 0.5, 1e-3
#: Updates of the responsibilities.
UPDATES = 60
#: Least share of starts in which the episodes of a mode are together, and least agreement between starts (of which 0 is
#: chance) for more than one mode; measured, see docs/modes.md.
TOGETHER, AGREE = 0.4, 0.2
#: Fewest steps between two updates.
LEAST_STEPS = 20


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
    numbers = {"components": (components, 2), "starts": (starts, 2), "updates": (updates, 1)}
    for name, (value, low) in (numbers | {"batch_size": (batch_size, 1), "seed": (seed, 0)}).items():
        check_number(name, value, low=low, integer=True)
    check_number("threshold", threshold, above=0, high=1)
    episodes = find_episodes(data, purpose="a search for modes", open_end=True)
    count = len(episodes.starts)
    if count < 6:
        raise ValueError(f"{count} episodes are too few to find modes among them: record at least 6")
    components = min(components, count // 3)
    sizes = [components if k % 2 == 0 else max(2, 2 * components // 3) for k in range(starts)]
    rows = data.select("observation", "action")
    scaled = RobustScaling.fit(rows)(rows).set("episode", episodes.of_rows())
    mixture = train_mixtures(
        scaled, sizes, seed=seed, updates=updates, batch_size=batch_size, device=device, progress=progress
    )
    found = list(mixture.responsibilities.split(sizes))
    pairs = together(found)
    modes = Modes(tuple(map(tuple, consensus(pairs, threshold))), pairs, torch.stack([x.argmax(0) for x in found]))
    if always or modes.agreement >= AGREE:
        return modes
    return replace(modes, groups=(tuple(range(count)),))


def train_mixtures(
    scaled: TensorDictBase,
    sizes: Sequence[int],
    *,
    seed: int,
    updates: int,
    batch_size: int = 256,
    known: Tensor | None = None,
    device: str | torch.device = "cpu",
    progress: bool = False,
) -> EpisodeMixture:
    """Trains mixtures beside one another, as stacked members of one program.

    Args:
        scaled: ``observation``, ``action`` and ``episode``, ``[N]``, as the policies take them.
        sizes: components of each mixture.
        seed: of the first parameters, the samples and the soft starts.
        updates: of the responsibilities, an epoch between two.
        batch_size: samples a step and component.
        known: episodes that each mixture may learn from, ``[G, E]`` bool. Default: all.
        device: of the policies.
        progress: whether to show a bar.

    Returns:
        The mixtures, with their loss.
    """
    members = sum(sizes)
    every = max(LEAST_STEPS, len(scaled) // batch_size)
    obs_dim, action_dim = scaled["observation"].shape[1], scaled["action"].shape[1]
    with undisturbed():
        torch.manual_seed(seed)
        actors = [make_policy(obs_dim, action_dim) for _ in range(members)]
        loss = TsallisBCLoss(actors, rating=PeakRating(beta=BETA)).to(device)
        seeds = [1000 * seed + member for member in range(members)]
        buffer = make_episode_buffer(scaled, seeds=seeds, batch_size=batch_size)
        annealing = Annealing(start=max(1, updates // 12), length=max(1, 2 * updates // 3))
        mixture = EpisodeMixture(loss, buffer, sizes, every=every, annealing=annealing, known=known, seed=seed)
        if torch.device(device).type != "cpu":
            buffer.append_transform(lambda batch: batch.to(device))
        optimizer = AdaTerm(loss.parameters(), lr=LR, batch_dims=1)
        steps = every * updates
        trainer = make_offline_trainer(
            loss, buffer, optimizer, steps=steps, tuner=ScoreTuner(loss), log_every=every, progress=progress
        )
        mixture.register(trainer)
        trainer.train()
    return mixture
