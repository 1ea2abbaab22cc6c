"""From demonstrations to their modes: starts of a mixture, what they agree on, and whether one mode is enough."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_tsallis._checks import check_number
from torchrl_tsallis.data.episodes import find_episodes
from torchrl_tsallis.data.robust_scaling import RobustScaling
from torchrl_tsallis.data.splits import fold_episodes
from torchrl_tsallis.modes.consensus import consensus, together
from torchrl_tsallis.modes.found import Modes, signed_rank
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
#: Updates of the responsibilities of a mixture on everything, and the share of them for one that is tested on what was
#: held out: longer, the components learn their own episodes by heart, and explain the others less than one policy does.
UPDATES, HELD_OUT_SHARE = 60, 2 / 3
#: Signed-rank statistic over the held-out episodes above which one mode is not enough.
SURE = 2.0
#: Fewest steps between two updates.
LEAST_STEPS = 20


def find_modes(
    data: TensorDictBase,
    *,
    components: int = 6,
    starts: int = 3,
    folds: int = 3,
    batch_size: int = 256,
    seed: int = 0,
    updates: int = UPDATES,
    threshold: float = 0.5,
    always: bool = False,
    device: str | torch.device = "cpu",
    progress: bool = False,
) -> Modes:
    """Finds modes of behaviour, whose units are whole episodes, without labels.

    1. Mixtures, and as many policies without modes as they have components, learn from all folds of the episodes but
       one. Unless the mixtures explain the held-out episodes better (:func:`~torchrl_tsallis.modes.found.signed_rank`
       over 2), there is one mode.
    2. Else mixtures are started anew on everything, and modes are groups of episodes that are of one component in
       most starts (:func:`~torchrl_tsallis.modes.consensus`). Components that share a behaviour, and share its
       episodes in one way here and in another there, become one mode by that.

    The number of components is an upper bound of the number of large modes. The same in other units, up to rounding.
    What this cannot see: demonstrators who act alike, and an operator who changes within an episode.

    Args:
        data: ``observation`` ``[N, O]``, ``action`` ``[N, A]``, with episodes.
        components: of each mixture; at most a third of the episodes are taken.
        starts: of the mixture on everything.
        folds: of the episodes.
        batch_size: samples a step and component.
        seed: of the folds, starts and policies.
        updates: of the responsibilities of a mixture on everything, an epoch between two.
        threshold: least share of starts in which the episodes of a mode are together.
        always: whether modes are looked for although one is enough.
        device: of the policies.
        progress: whether to show bars.

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
    numbers = {"components": (components, 2), "starts": (starts, 2), "folds": (folds, 2), "updates": (updates, 1)}
    for name, (value, low) in (numbers | {"batch_size": (batch_size, 1), "seed": (seed, 0)}).items():
        check_number(name, value, low=low, integer=True)
    check_number("threshold", threshold, above=0, high=1)
    episodes = find_episodes(data, purpose="a search for modes", open_end=True)
    count = len(episodes.starts)
    if count < 6:
        raise ValueError(f"{count} episodes are too few to find modes among them: record at least 6")
    components, folds = min(components, count // 3), min(folds, count // 2)
    rows = data.select("observation", "action")
    scaled = RobustScaling.fit(rows)(rows).set("episode", episodes.of_rows())
    first = episodes.starts
    known = torch.stack([~mask[first] for mask in fold_episodes(scaled, folds, seed=seed)])
    sizes = [1] * (components * folds) + [components] * folds
    shared: dict[str, Any] = {"batch_size": batch_size, "device": device, "progress": progress}
    short = max(1, round(HELD_OUT_SHARE * updates))
    seen = torch.cat([known.repeat(components, 1), known])
    mixture = train_mixtures(scaled, sizes, seed=seed, known=seen, updates=short, **shared)
    score = _held_out(mixture, episodes.lengths, folds)
    held = known.logical_not().int().argmax(0)
    one, several = (part[held, torch.arange(count)] for part in score)
    if signed_rank(several - one) <= SURE and not always:
        everything = tuple(range(count))
        pairs = torch.ones(count, count, dtype=torch.float64)
        return Modes((everything,), pairs, torch.zeros(1, count, dtype=torch.int64), one, several)
    mixture = train_mixtures(scaled, [components] * starts, seed=seed + folds, updates=updates, **shared)
    found = list(mixture.responsibilities.split(components))
    pairs = together(found)
    groups = tuple(map(tuple, consensus(pairs, threshold)))
    return Modes(groups, pairs, torch.stack([start.argmax(0) for start in found]), one, several)


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


def _held_out(mixture: EpisodeMixture, lengths: Tensor, folds: int) -> tuple[Tensor, Tensor]:
    r"""Log-likelihood a step of every episode, ``[F, E]``: under policies that have the same data, and under mixtures.

    .. math:: \frac{1}{T_e} \ln \sum_c \pi_c \, e^{T_e \bar\ell_{ec}}

    There are as many policies of the same data as components, with equal shares: the best of several explains an
    episode better than one does, whether there are modes or not.
    """
    given, share = mixture.log_likelihood() * lengths, mixture.share.clamp_min(1e-12).log()
    alone = sum(size == 1 for size in mixture.sizes)
    same = given[:alone].unflatten(0, (-1, folds))
    several = [part.logsumexp(0) for part in (given[alone:] + share[alone:, None]).split(mixture.sizes[alone:])]
    return (same.logsumexp(0) - math.log(len(same))) / lengths, torch.stack(several) / lengths
