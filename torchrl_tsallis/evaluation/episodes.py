"""Episodes of one policy in several environments at once, so that a policy in NumPy acts on them in one call."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

Policy = Callable[[np.ndarray], np.ndarray]
EnvFn = str | Callable[..., Any]


class EpisodeError(Exception):
    """An episode failed; the cause says why.

    Args:
        seed: of the episode.
    """

    def __init__(self, seed: int) -> None:
        super().__init__(f"the episode of seed {seed} failed")
        self.seed = seed


def resolve(env_fn: EnvFn) -> Callable[..., Any]:
    """Imports ``"module:function"``; a callable passes through.

    Examples:
        >>> resolve("math:sqrt")(4.0)
        2.0
    """
    if callable(env_fn):
        return env_fn
    module, _, name = env_fn.partition(":")
    if not name:
        raise ValueError(f"env_fn must be 'module:function' or a callable, got {env_fn!r}")
    found: Callable[..., Any] = getattr(importlib.import_module(module), name)
    return found


def make_environment(env_fn: EnvFn, seed: int) -> Any:
    """Makes an environment whose next reset starts an episode that depends on its seed alone.

    It is reset once and that episode is thrown away, because PyBullet's first episode differs: the floor joins the
    scene's parts only after that reset.

    Args:
        env_fn: makes a Gymnasium environment.
        seed: of the reset.

    Returns:
        The environment.

    Raises:
        EpisodeError: if that fails.
    """
    try:
        env = resolve(env_fn)()
        env.reset(seed=seed)
    except Exception as error:
        raise EpisodeError(seed) from error
    return env


def run_episodes(policy: Policy, envs: Sequence[Any], seeds: Sequence[int]) -> list[tuple[float, int]]:
    """Runs one episode an environment, a step of each in turn.

    A result does not depend on the other episodes: a policy is called once for all of them only if it promises by an
    attribute ``batched`` that its rows do not depend on each other, as :class:`MeanPolicy` does.

    Args:
        policy: maps an observation ``[*O]`` to an action ``[*A]``, which is clipped to the action space; if its
            attribute ``batched`` is true, maps ``[E, *O]`` to ``[E, *A]``. It must not remember earlier observations,
            because episodes take turns.
        envs: at least as many environments as seeds, all alike, from :func:`make_environment`.
        seeds: given to ``reset``.

    Returns:
        The sum of rewards and the number of steps of each episode.

    Raises:
        EpisodeError: if an episode fails, or the policy gives a wrong shape or a number that is not finite.
    """
    totals, lengths = [0.0] * len(seeds), [0] * len(seeds)
    running, slot, batched = list(range(len(seeds))), 0, getattr(policy, "batched", False)
    try:
        low, high = envs[0].action_space.low, envs[0].action_space.high
        observations = {}
        for slot in running:
            observations[slot], _ = envs[slot].reset(seed=seeds[slot])
        while running:
            actions: Any = []
            if batched:
                slot = running[0]
                actions = np.asarray(policy(np.array([observations[slot] for slot in running])))
            else:
                for slot in running:
                    actions.append(np.asarray(policy(observations[slot])))
            # The second test looks at all actions at once, for speed, as does the clipping, which is np.clip's.
            if any(action.shape != low.shape for action in actions) or not np.isfinite(actions).all():
                for slot, action in zip(running, actions, strict=True):
                    if action.shape != low.shape or not np.isfinite(action).all():
                        raise ValueError(
                            f"step {lengths[slot]}: need a finite action of shape {low.shape}, got {action}"
                        )
            clipped = np.minimum(np.maximum(actions, low), high).astype(low.dtype, copy=False)
            over = []
            for slot, action in zip(running, clipped, strict=True):
                observations[slot], reward, terminated, truncated, _ = envs[slot].step(action)
                totals[slot] += float(reward)
                lengths[slot] += 1
                if terminated or truncated:
                    over.append(slot)
            if over:
                running = [slot for slot in running if slot not in over]
        return list(zip(totals, lengths, strict=True))
    except Exception as error:
        raise EpisodeError(seeds[slot]) from error


def run_episode(policy: Policy, env_fn: EnvFn, seed: int) -> tuple[float, int]:
    """Runs one episode in an environment of its own.

    Args:
        policy: as for :func:`run_episodes`.
        env_fn: makes a Gymnasium environment.
        seed: of the episode.

    Returns:
        The sum of rewards and the number of steps.

    Raises:
        EpisodeError: as :func:`run_episodes`.
    """
    env = make_environment(env_fn, seed)
    try:
        return run_episodes(policy, [env], [seed])[0]
    finally:
        env.close()
