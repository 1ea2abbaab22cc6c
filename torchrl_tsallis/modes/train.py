"""Mixtures of several starts, and of several sets of demonstrations, trained as one program."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase

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
#: Fewest steps between two updates.
LEAST_STEPS = 20


def steps_between(rows: int, batch_size: int) -> int:
    """Steps between two updates of the responsibilities: an epoch, and not fewer than 20.

    Examples:
        >>> steps_between(10_000, 256), steps_between(100, 256)
        (39, 20)
    """
    return max(LEAST_STEPS, rows // batch_size)


def train_mixtures(
    sets: Sequence[TensorDictBase],
    sizes: Sequence[int],
    *,
    seeds: Sequence[int],
    updates: int,
    batch_size: int = 256,
    device: str | torch.device = "cpu",
    progress: bool = False,
) -> EpisodeMixture:
    """Trains mixtures of each set beside one another, as stacked members of one program.

    Args:
        sets: ``observation``, ``action`` and ``episode``, ``[N]``, as the policies take them.
        sizes: components of each mixture of a set.
        seeds: of the first parameters, the samples and the soft starts; one a set.
        updates: of the responsibilities, an epoch between two.
        batch_size: samples a step and component.
        device: of the policies.
        progress: whether to show a bar.

    Returns:
        The mixtures, set by set, with their loss.
    """
    of_a_set, count = sum(sizes), len(sets)
    every = steps_between(sum(map(len, sets)) // count, batch_size)
    obs_dim, action_dim = sets[0]["observation"].shape[1], sets[0]["action"].shape[1]
    episodes = [int(data["episode"].max()) + 1 for data in sets]
    first = [sum(episodes[:k]) for k in range(count)]
    rows = torch.cat(
        [data.clone(False).set("episode", data["episode"] + k) for data, k in zip(sets, first, strict=True)]
    )
    of_episodes = torch.arange(count).repeat_interleave(torch.tensor(episodes))
    known = (of_episodes == torch.arange(count)[:, None]).repeat_interleave(len(sizes), 0)
    with undisturbed():
        actors = []
        for seed in seeds:
            torch.manual_seed(seed)
            actors += [make_policy(obs_dim, action_dim) for _ in range(of_a_set)]
        loss = TsallisBCLoss(actors, rating=PeakRating(beta=BETA)).to(device)
        of_samples = [1000 * seed + member for seed in seeds for member in range(of_a_set)]
        buffer = make_episode_buffer(rows, seeds=of_samples, batch_size=batch_size, device=device)
        annealing = Annealing(start=max(1, updates // 12), length=max(1, 2 * updates // 3))
        soft = [seed + g for seed in seeds for g in range(len(sizes))]
        mixture = EpisodeMixture(
            loss, buffer, list(sizes) * count, every=every, annealing=annealing, known=known, seed=soft
        )
        optimizer = AdaTerm(loss.parameters(), lr=LR, batch_dims=1)
        steps = every * updates
        trainer = make_offline_trainer(
            loss, buffer, optimizer, steps=steps, tuner=ScoreTuner(loss), log_every=every, progress=progress
        )
        mixture.register(trainer)
        trainer.train()
    return mixture
