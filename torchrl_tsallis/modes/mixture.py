"""A mixture of rated policies whose units are whole episodes, as a hook of TorchRL's trainer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import ReplayBuffer
from torchrl.trainers import Trainer, TrainerHookBase

from torchrl_tsallis._checks import check_number
from torchrl_tsallis.modes.likelihood import episode_means, robust_log_prob
from torchrl_tsallis.modes.responsibilities import Annealing, random_responsibilities, responsibilities
from torchrl_tsallis.modes.sampler import EpisodeSampler
from torchrl_tsallis.objectives.actor import get_stacked_dist
from torchrl_tsallis.objectives.asking import evaluating
from torchrl_tsallis.objectives.bc import TsallisBCLoss
from torchrl_tsallis.ratings.normal import diagonal_normal


class EpisodeMixture(TrainerHookBase):
    r"""Finds which demonstrator an episode is of, without labels, while the components' policies train.

    The stacked members of a loss are components of one mixture, or of several that have nothing in common. Every
    ``every`` steps each episode's responsibilities are computed from the mean robust log-likelihood a step under each
    component (:func:`robust_log_prob`), and averaged with the last ones; each component then draws episodes in
    proportion to them. The temperature rises from a soft start.

    Args:
        loss: of stacked members, with a diagonal normal actor; any rating.
        buffer: of :func:`make_episode_buffer`, with a seed a member.
        sizes: components of each mixture; their sum is the number of members.

    Keyword Args:
        every (int): steps between two updates; an epoch of a component is a good choice.
        annealing (Annealing): of the temperature. Default: 0.5 to 20 over 40 updates, from the fifth on.
        known (Tensor): episodes that each mixture may learn from, ``[G, E]`` bool; others get responsibilities, and
            are never drawn. Default: all.
        seed (int | Sequence[int]): of the soft starts, one a mixture; of a single one, mixture g has seed + g.
            Default: 0.
        steps_per_episode (int): rows of an episode that an update looks at, evenly spread. Default: 128.

    Attributes:
        responsibilities: ``[S, E]`` float64; the sum over the components of a mixture is 1.

    Raises:
        ValueError: if the numbers of members differ, the buffer draws no episodes, or a number is outside of its range.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_tsallis import PeakRating
        >>> from torchrl_tsallis.modes import make_episode_buffer
        >>> from torchrl_tsallis.modules import make_policy
        >>> data = TensorDict({"observation": torch.rand(40, 3), "action": torch.rand(40, 2)}, [40])
        >>> buffer = make_episode_buffer(data.set("episode", torch.arange(40) // 10), seeds=[0, 1], batch_size=8)
        >>> loss = TsallisBCLoss([make_policy(3, 2), make_policy(3, 2)], rating=PeakRating())
        >>> mixture = EpisodeMixture(loss, buffer, [2], every=10)
        >>> mixture.responsibilities.shape, mixture.responsibilities.sum(0).allclose(torch.ones(4).double())
        (torch.Size([2, 4]), True)
    """

    def __init__(
        self,
        loss: TsallisBCLoss,
        buffer: ReplayBuffer,
        sizes: Sequence[int],
        *,
        every: int,
        annealing: Annealing | None = None,
        known: Tensor | None = None,
        seed: int | Sequence[int] = 0,
        steps_per_episode: int = 128,
    ) -> None:
        sampler = buffer.sampler
        if not isinstance(sampler, EpisodeSampler):
            raise ValueError(f"the buffer has a {type(sampler).__name__}: make it with make_episode_buffer")
        members = len(sampler.generators)
        if loss.num_members != members or sum(sizes) != members or min(sizes, default=0) < 1:
            raise ValueError(
                f"sizes={list(sizes)}, {loss.num_members or 'no'} stacked members and {members} seeds of the buffer: "
                "give as many actors and seeds as the components of all mixtures together"
            )
        self.loss, self.sampler, self.sizes = loss, sampler, list(sizes)
        self.every = int(check_number("every", every, low=1, integer=True))
        check_number("steps_per_episode", steps_per_episode, low=1, integer=True)
        seeds = [seed + g for g in range(len(self.sizes))] if isinstance(seed, int) else list(seed)
        for value in seeds:
            check_number("seed", value, low=0, integer=True)
        self.annealing = annealing or Annealing()
        episodes = sampler.episodes
        count = len(episodes.starts)
        self.known = torch.ones(len(self.sizes), count, dtype=torch.bool) if known is None else known
        if self.known.shape != (len(self.sizes), count) or self.known.dtype != torch.bool:
            raise ValueError(f"known has shape {list(self.known.shape)}, needed is bool {[len(self.sizes), count]}")
        take = torch.minimum(episodes.lengths, torch.tensor(steps_per_episode))
        self._episode = torch.arange(count).repeat_interleave(take)
        place = torch.arange(len(self._episode)) - (take.cumsum(0) - take)[self._episode]
        rows = episodes.starts[self._episode] + (place * episodes.lengths[self._episode]) // take[self._episode]
        self._rows: Any = buffer[rows]
        self.responsibilities = torch.empty(members, count, dtype=torch.float64)
        start = 0
        for size, mine, value in zip(self.sizes, self.known, seeds, strict=True):
            own = self.responsibilities[start : start + size]
            own[:] = 1.0 / size
            own[:, mine] = random_responsibilities(size, int(mine.sum()), torch.Generator().manual_seed(value))
            start += size
        self.updates = self.steps = 0
        self._draw_by_them()

    def _draw_by_them(self) -> None:
        known = self.known.repeat_interleave(torch.tensor(self.sizes), 0)
        weights = self.responsibilities * known
        # A component that has lost all of its episodes goes on with a trace of every one.
        self.sampler.weights = (weights + 1e-6 * known).clamp_min(0)

    @property
    def share(self) -> Tensor:
        """Share of the known episodes that each component has, ``[S]``."""
        known = self.known.repeat_interleave(torch.tensor(self.sizes), 0)
        return (self.responsibilities * known).sum(1) / known.sum(1)

    def log_likelihood(self, rows: TensorDictBase | None = None, episode: Tensor | None = None) -> Tensor:
        """Mean robust log-likelihood a step of every episode under every component, ``[S, E]`` float64.

        Args:
            rows: observations and actions as the policies were given them, ``[N]``. Default: those of an update.
            episode: number of each row's episode, ``[N]``.
        """
        given, number = (self._rows, self._episode) if rows is None else (rows, episode)
        assert number is not None
        parts = []
        members = len(self.responsibilities)
        device = next(self.loss.parameters()).device
        size = max(1, (2**15 if device.type == "cpu" else 2**20) // members)
        with evaluating(self.loss, self.loss.actor_network):
            for start in range(0, len(given), size):
                part = given[start : start + size].to(device)
                wide = part.expand(members, *part.batch_size)
                dist = get_stacked_dist(self.loss.actor_network, wide, self.loss.actor_network_params)
                normal = diagonal_normal(dist, wide["action"])
                if normal is None:
                    raise ValueError("a mixture needs an actor whose distribution is a diagonal normal")
                parts.append(robust_log_prob(normal).cpu())
        return episode_means(torch.cat(parts, 1), number, int(number.max()) + 1)

    @torch.no_grad()
    def update(self) -> None:
        """Computes the responsibilities anew, where the annealing has begun."""
        temperature = self.annealing.temperature(self.updates)
        self.updates += 1
        if not temperature:
            return
        given, share, start = self.log_likelihood(), self.share, 0
        for size in self.sizes:
            own = slice(start, start + size)
            new = responsibilities(given[own], share[own], temperature)
            self.responsibilities[own] = (self.responsibilities[own] + new) / 2
            start += size
        self._draw_by_them()

    def __call__(self) -> None:
        """The trainer's hook, after each step."""
        self.steps += 1
        if self.steps % self.every == 0:
            self.update()

    def register(self, trainer: Trainer, name: str = "episode_mixture") -> None:
        """Registers the updates after each optimizer step, and for checkpoints."""
        trainer.register_op("post_optim", self)
        trainer.register_module(name, self)

    def state_dict(self) -> dict[str, Any]:
        """Responsibilities and counts."""
        return {"responsibilities": self.responsibilities.clone(), "updates": self.updates, "steps": self.steps}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores the state."""
        given = state_dict["responsibilities"]
        if given.shape != self.responsibilities.shape:
            raise ValueError(
                f"the checkpoint has {list(given.shape)} components and episodes, the mixture "
                f"{list(self.responsibilities.shape)}: resume with the same components and episodes"
            )
        self.responsibilities = given.clone()
        self.updates, self.steps = int(state_dict["updates"]), int(state_dict["steps"])
        self._draw_by_them()
