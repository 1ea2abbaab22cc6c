"""Episodes of one policy in several environments at once, so that a policy in NumPy acts on them in one call."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from torchrl_tsallis.evaluation.interface import ActionRule, begin, is_structured, name_of, observation_shape, take
from torchrl_tsallis.evaluation.ownership import Policy, act, left_as_found, own_copy

EnvFn = str | Callable[..., Any]
#: Longest episode, unless another one is asked for; an environment without a limit of its own would never end.
MAX_STEPS = 10_000


class Episode(NamedTuple):
    """What an episode gave.

    Args:
        total: sum of rewards.
        length: steps.
        cut: whether it was ended at the longest length, instead of by its environment.
    """

    total: float
    length: int
    cut: bool


class EpisodeError(Exception):
    """An episode failed; the cause says why.

    Args:
        seed: of the episode.
    """

    def __init__(self, seed: int) -> None:
        super().__init__(f"the episode of seed {seed} failed")
        self.seed = seed


def checked_env_fn(env_fn: Any) -> EnvFn:
    """Checks what makes environments, without importing or making anything.

    Raises:
        TypeError: if it is an environment, or neither a callable nor a text.
        ValueError: for a text that does not name a function of a module.

    Examples:
        >>> checked_env_fn("Robot-v1")
        Traceback (most recent call last):
        ...
        ValueError: env_fn must be 'module:function' or a callable, got 'Robot-v1': for an environment's id, use
        functools.partial(gymnasium.make, 'Robot-v1')
    """
    if callable(env_fn):
        found: EnvFn = env_fn
        return found
    if not isinstance(env_fn, str):
        kind = type(env_fn).__name__
        raise TypeError(f"env_fn must be 'module:function' or a callable that makes the environment, got a {kind}")
    module, colon, name = env_fn.partition(":")
    if not (module and colon and name):
        raise ValueError(
            f"env_fn must be 'module:function' or a callable, got {env_fn!r}: for an environment's id, use "
            f"functools.partial(gymnasium.make, {env_fn!r})"
        )
    return env_fn


def resolve(env_fn: EnvFn) -> Callable[..., Any]:
    """Imports ``"module:function"``; a callable passes through.

    Examples:
        >>> resolve("math:sqrt")(4.0)
        2.0
    """
    env_fn = checked_env_fn(env_fn)
    if not isinstance(env_fn, str):
        return env_fn
    module, _, name = env_fn.partition(":")
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
        EpisodeError: if that fails, or its actions are of a space that policies cannot act in.
    """
    try:
        env = resolve(env_fn)()
        try:
            begin(env, seed, observation_shape(env))
            ActionRule(env)
        except BaseException:
            getattr(env, "close", lambda: None)()
            raise
    except Exception as error:
        raise EpisodeError(seed) from error
    return env


def run_episodes(
    policy: Policy, envs: Sequence[Any], seeds: Sequence[int], *, max_steps: int = MAX_STEPS
) -> list[Episode]:
    """Runs one episode an environment, a step of each in turn.

    A result does not depend on the other episodes: a policy with memory, which its ``reset()`` tells, gets a copy an
    episode (see :func:`~torchrl_tsallis.evaluation.ownership.own_copy`), and a policy is called once for all of them
    only if it promises by an attribute ``batched`` that its rows do not depend on each other, as :class:`MeanPolicy`
    does. A policy that remembers without a ``reset()`` cannot be told from one that does not: it must not be run here.

    Args:
        policy: maps an observation ``[*O]`` to an action ``[*A]``, see
            :class:`~torchrl_tsallis.evaluation.interface.ActionRule`; if its attribute ``batched`` is true, maps
            ``[E, *O]`` to ``[E, *A]``. Observations of Dict and Tuple spaces are passed on as they are.
        envs: at least as many environments as seeds, all alike, from :func:`make_environment`.
        seeds: given to ``reset``.
        max_steps: longest episode (10000).

    Returns:
        The sum of rewards, the number of steps, and whether it was cut at the longest length, of each episode.

    Raises:
        EpisodeError: if an episode fails, the policy gives what is no action, or the environment what is no step.
    """
    totals, lengths = [0.0] * len(seeds), [0] * len(seeds)
    running, slot, batched = list(range(len(seeds))), 0, bool(getattr(policy, "batched", False))
    try:
        rule, shape = ActionRule(envs[0]), observation_shape(envs[0])
        own = [own_copy(policy) for _ in seeds]
        together = batched and all(copy is policy for copy in own)
        observations = {}
        for slot in running:
            observations[slot] = begin(envs[slot], seeds[slot], shape)
            if batched and is_structured(observations[slot]):
                raise ValueError(
                    f"an observation of {name_of(envs[slot])} has several parts, a batched policy takes one array: "
                    "flatten it, gymnasium.wrappers.FlattenObservation, or leave out the policy's attribute batched"
                )
        while running:
            actions: Any = []
            if together:
                slot = running[0]
                actions = _batch(policy, [observations[slot] for slot in running])
            else:
                for slot in running:
                    seen = observations[slot]
                    actions.append(_batch(own[slot], [seen])[0] if batched else act(own[slot], seen))
            over, legal = [], rule.legal(actions)
            if legal is None:
                for slot, action in zip(running, actions, strict=True):
                    if fault := rule.fault(action):
                        raise ValueError(f"step {lengths[slot]}: {fault}{_unseen(observations[slot])}")
            for slot, action in zip(running, () if legal is None else legal, strict=True):
                observations[slot], reward, terminated, truncated = take(envs[slot], action, shape)
                totals[slot] += reward
                lengths[slot] += 1
                if terminated or truncated:
                    over.append(slot)
            if over:
                running = [slot for slot in running if slot not in over]
            if running and lengths[running[0]] >= max_steps:  # all that run are equally long
                break
        for slot, total in enumerate(totals):
            if not math.isfinite(total):
                raise ValueError(f"the rewards of {name_of(envs[slot])} sum to {total}: it must give finite ones")
        cut = set(running)
        return [Episode(totals[i], lengths[i], i in cut) for i in range(len(seeds))]
    except Exception as error:
        raise EpisodeError(seeds[slot]) from error


def _batch(policy: Policy, observations: list[Any]) -> np.ndarray:
    """Actions ``[E, *A]`` of a batched policy for E observations."""
    actions = act(policy, np.array(observations))
    if actions.shape[:1] != (len(observations),):
        raise ValueError(f"a batched policy gave shape {actions.shape} for {len(observations)} observations")
    return actions


def _unseen(observation: Any) -> str:
    """Says so where a bad action may come from a bad observation."""
    bad = isinstance(observation, np.ndarray) and observation.dtype.kind == "f" and not np.isfinite(observation).all()
    return "; the observation is not finite either, which is the environment's fault" if bad else ""


def run_episode(policy: Policy, env_fn: EnvFn, seed: int, *, max_steps: int = MAX_STEPS) -> tuple[float, int]:
    """Runs one episode in an environment of its own.

    Args:
        policy: as for :func:`run_episodes`.
        env_fn: makes a Gymnasium environment.
        seed: of the episode.
        max_steps: longest episode (10000).

    Returns:
        The sum of rewards and the number of steps.

    Raises:
        EpisodeError: as :func:`run_episodes`.
    """
    with left_as_found([policy]):
        env = make_environment(env_fn, seed)
        try:
            return run_episodes(policy, [env], [seed], max_steps=max_steps)[0][:2]
        finally:
            env.close()
