"""Trials of page flipping: what a policy does in the simulator, and how it is counted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchrl_tsallis.envs.flips import FlipCount, count_flips
from torchrl_tsallis.evaluation.ownership import act, as_policy, left_as_found

#: Successive single flips that make a trial a success.
SUCCESS_RUN = 3


@dataclass(frozen=True)
class FlipTrial:
    """One trial.

    Args:
        positions: of the tip before each step, ``[T, 3]`` in m.
        forces: exerted, ``[T, 3]`` in N.
        angles: of the pages' free edges, ``[T + 1, pages]`` in rad.
        flips: what was flipped.
    """

    positions: np.ndarray
    forces: np.ndarray
    angles: np.ndarray
    flips: FlipCount

    @property
    def row(self) -> dict[str, int]:
        """Counts of flipped ``pages``, their ``events``, ``singles``, ``multiples``, the ``run``, and ``success``."""
        run = longest_single_run(self.flips.sizes)
        return {
            "flips": self.flips.total,
            "events": len(self.flips.sizes),
            "singles": self.flips.singles,
            "multiples": self.flips.multiples,
            "run": run,
            "success": int(run >= SUCCESS_RUN),
        }


def longest_single_run(sizes: Sequence[int] | np.ndarray) -> int:
    """Most single flips in succession; a flip of several pages breaks the succession.

    Args:
        sizes: pages of each flip event in the order of time, ``[E]``.

    Examples:
        >>> longest_single_run([1, 1, 2, 1, 1, 1])
        3
    """
    longest = run = 0
    for size in sizes:
        run = run + 1 if size == 1 else 0
        longest = max(longest, run)
    return longest


def run_flip_trial(policy: Any, seed: int, *, make_env: Callable[[], Any] | None = None) -> FlipTrial:
    """Lets a policy flip pages for one trial.

    The environment shortens a force beyond the arm's 3.3 N. A trial depends on policy and seed alone. The policy's mode
    and the random numbers are left as they were.

    Args:
        policy: observation ``[12]`` -> force ``[3]`` in N, or an actor of TorchRL. Its ``reset()``, if it has one, is
            called first.
        seed: of the trial.
        make_env: makes the environment. Default: :func:`~torchrl_tsallis.envs.page_flip.make_page_flip`.

    Returns:
        The trial.

    Raises:
        ValueError: if the policy's force has a wrong shape or is not finite; the message names step and seed.
    """
    if make_env is None:
        from torchrl_tsallis.envs.page_flip import make_page_flip

        make_env = make_page_flip
    policy = as_policy("policy", policy)
    with left_as_found([policy]):
        return _run(policy, seed, make_env())


def _run(policy: Any, seed: int, env: Any) -> FlipTrial:
    try:
        observation, info = env.reset(seed=seed)
        getattr(policy, "reset", lambda: None)()
        positions: list[np.ndarray] = []
        forces: list[np.ndarray] = []
        angles: list[np.ndarray] = [info["edge_angles"]]
        over = False
        while not over:
            force = act(policy, observation)
            if force.shape != (3,) or not np.isfinite(force).all():
                raise ValueError(f"step {len(forces)} of seed {seed}: need a finite force [3] in N, got {force}")
            positions.append(observation[:3])
            observation, _, terminated, truncated, info = env.step(force)
            forces.append(observation[3:6])  # as exerted
            angles.append(info["edge_angles"])
            over = bool(terminated or truncated)
        history = np.stack(angles)
        return FlipTrial(np.stack(positions), np.stack(forces), history, count_flips(history))
    finally:
        env.close()
