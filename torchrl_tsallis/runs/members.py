"""Policies of several seeds and folds, trained as one program, and what they think of every row."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.distributions import Distribution

from torchrl_tsallis.data.robust_scaling import RobustScaling
from torchrl_tsallis.data.rows import take_rows
from torchrl_tsallis.data.splits import fold_episodes
from torchrl_tsallis.data.stacked import make_stacked_replay_buffer
from torchrl_tsallis.modules.policy import make_policy
from torchrl_tsallis.objectives.actor import get_stacked_dist
from torchrl_tsallis.objectives.asking import evaluating
from torchrl_tsallis.objectives.bc import TsallisBCLoss
from torchrl_tsallis.optim.adaterm import AdaTerm
from torchrl_tsallis.ratings.normal import diagonal_normal, squared_distance
from torchrl_tsallis.ratings.peak import PeakRating
from torchrl_tsallis.ratings.score_tuner import ScoreTuner
from torchrl_tsallis.trainers.hooks import undisturbed
from torchrl_tsallis.trainers.offline import make_offline_trainer

#: Power of the scale-weighted likelihood, and the size of AdaTerm's steps.
BETA, LR = 0.5, 1e-3
#: Passes over the data, and bounds of the steps that they give.
EPOCHS, LEAST_STEPS, MOST_STEPS = 40, 1000, 10_000


@dataclass(frozen=True)
class Split:
    """The training data of one policy.

    Args:
        seed: of its first parameters, of the order of its samples, and of the folds.
        held_out: rows that it does not see, ``[N]`` bool.
    """

    seed: int
    held_out: Tensor


def default_steps(rows: int, batch_size: int = 256) -> int:
    """Gradient steps for so much data: 40 passes, from 1000 to 10,000 steps, in hundreds.

    More passes fit the training episodes better and other episodes worse: on 25 episodes of a person, the squared
    errors on held-out episodes were 1.7 and 2.6 times what the policies expected after 300 and 1000 steps.

    Examples:
        >>> default_steps(30_000), default_steps(500), default_steps(10**6)
        (4700, 1000, 10000)
    """
    return min(MOST_STEPS, max(LEAST_STEPS, round(EPOCHS * rows / batch_size / 100) * 100))


def make_splits(data: TensorDictBase, *, seeds: int, folds: int) -> list[Split]:
    """Deals the episodes into folds anew for each seed, so that seeds differ in all that chance decides.

    Args:
        data: ``[N]``, with episodes.
        seeds: how many.
        folds: of each seed. Every row is held out once a seed.

    Returns:
        ``seeds * folds`` splits, those of one seed together.

    Raises:
        ValueError: if there are fewer episodes than folds.
    """
    return [Split(seed, held_out) for seed in range(seeds) for held_out in fold_episodes(data, folds, seed=seed)]


class Members:
    """Stacked policies, each with the scaling of its own training data.

    Args:
        loss: of the stacked members, ``[M]``.
        scalings: one a member.
    """

    def __init__(self, loss: TsallisBCLoss, scalings: Sequence[RobustScaling]) -> None:
        self.loss = loss
        self.scalings = list(scalings)

    def actor_state(self, member: int) -> dict[str, Tensor]:
        """Parameters of a member's actor, by its own names."""
        return {name: value.cpu() for name, value in self.loss.member_state_dict(member).items()}

    def rating_state(self, member: int) -> dict[str, Tensor]:
        """Settings and running statistics of a member's rating."""
        state = self.loss.rating_module.state_dict()
        return {name: value[member].clone().cpu() for name, value in state.items()}

    def ask(self, data: TensorDictBase, *, chunk_size: int = 2048) -> tuple[Tensor, Tensor]:
        """Distance and rating of every row by every member.

        Args:
            data: ``observation`` ``[N, O]`` and ``action`` ``[N, A]``, in their own units.
            chunk_size: rows at once.

        Returns:
            Squared distances of the actions from the policies' means, in the scales of good data, and the ratings,
            ``[M, N]`` each.
        """
        distance, rating = (torch.empty(len(self.scalings), len(data)) for _ in range(2))
        share: Tensor = self.loss.rating_module.variance_share[:, None]
        for part, scaled, dist in self._asked(data, chunk_size):
            normal = diagonal_normal(dist, scaled["action"])
            assert normal is not None  # make_policy's distribution
            distance[:, part] = (share * squared_distance(normal)).cpu()
            rating[:, part] = self.loss.rating(scaled).cpu()
        return distance, rating

    def means(self, data: TensorDictBase, *, chunk_size: int = 2048) -> Tensor:
        """Mean action of every member at every row, in the units of the data, ``[M, N, A]``.

        Args:
            data: ``observation`` ``[N, O]`` and ``action`` ``[N, A]``, in their own units.
            chunk_size: rows at once.
        """
        out = torch.empty(len(self.scalings), *data["action"].shape)
        for part, _, dist in self._asked(data, chunk_size):
            for member, scaling in enumerate(self.scalings):
                out[member, part] = scaling.unscale_action(dist.mean[member].cpu())
        return out

    def _asked(self, data: TensorDictBase, chunk_size: int) -> Iterator[tuple[slice, Any, Distribution]]:
        """Parts of the data, as each member's scaling gives them, and what the members make of them."""
        device = next(self.loss.parameters()).device
        for start in range(0, len(data), chunk_size):
            part = slice(start, min(start + chunk_size, len(data)))
            rows = data[part].select("observation", "action").clone()
            scaled: Any = torch.stack([scaling(rows) for scaling in self.scalings]).to(device)  # type: ignore[arg-type]
            with evaluating(self.loss, self.loss.actor_network):
                dist = get_stacked_dist(self.loss.actor_network, scaled, self.loss.actor_network_params)
            yield part, scaled, dist


def train_members(
    data: TensorDictBase,
    splits: Sequence[Split],
    *,
    steps: int,
    batch_size: int,
    device: str | torch.device = "cpu",
    progress: bool = False,
) -> Members:
    """Trains a policy a split, all of them in one program.

    The scaling of each is fitted to its own training rows. A policy whose training rows are fewer than a batch makes
    the batches of all as small as its rows. The caller's random numbers stay as they are.

    Args:
        data: ``observation`` ``[N, O]`` and ``action`` ``[N, A]``.
        splits: one a policy.
        steps: gradient steps.
        batch_size: samples a step and policy.
        device: of the policies.
        progress: whether to show a bar.

    Returns:
        The policies.

    Raises:
        ValueError: if a split leaves fewer than two rows, or a number is outside of its range.
        FloatingPointError: if the steps are not finite.
    """
    rows = data.select("observation", "action")
    parts: list[TensorDictBase] = []
    scalings = []
    for split in splits:
        part = take_rows(rows, ~split.held_out) if bool(split.held_out.any()) else rows
        if len(part) < 2:
            raise ValueError(f"a policy would be trained on {len(part)} rows, needed are two: record more episodes")
        scaling = RobustScaling.fit(part)
        scalings.append(scaling)
        parts.append(scaling(part))
    seeds = [split.seed for split in splits]
    batch_size = min(batch_size, *(len(part) for part in parts))
    with undisturbed():
        actors = []
        for seed in seeds:
            torch.manual_seed(seed)
            actors.append(make_policy(rows["observation"].shape[1], rows["action"].shape[1]))
        loss = TsallisBCLoss(actors, rating=PeakRating(beta=BETA)).to(device)
        buffer = make_stacked_replay_buffer(parts, seeds=seeds, batch_size=batch_size, device=device)
        del parts
        trainer = make_offline_trainer(
            loss,
            buffer,
            AdaTerm(loss.parameters(), lr=LR, batch_dims=1),
            steps=steps,
            tuner=ScoreTuner(loss),
            log_every=grain(steps),
            progress=progress,
        )
        trainer.train()
    return Members(loss, scalings)


def grain(steps: int) -> int:
    """The largest number up to 100 that divides the steps.

    Examples:
        >>> grain(2000), grain(150), grain(7)
        (100, 75, 7)
    """
    return next(k for k in range(min(100, steps), 0, -1) if steps % k == 0)
