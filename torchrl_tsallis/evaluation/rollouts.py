"""Parallel evaluation of deterministic policies: raw returns of every episode, on common seeds."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from torchrl_tsallis.evaluation.episodes import EnvFn, EpisodeError, Policy, make_environment, run_episodes
from torchrl_tsallis.evaluation.mean_policy import MeanPolicy
from torchrl_tsallis.jobs import WorkerDiedError, finished_jobs

Task = tuple[str, int]
DEFAULT_ENV = "torchrl_tsallis.envs:make_ant"
#: Most episodes that a worker steps in turn: fewer batch the policy less, more crowd the processor's caches.
GROUP = 4
_WORKER: dict[str, Any] = {}


def evaluate_policies(
    policies: Mapping[str, Mapping[str, Any] | Policy],
    *,
    episodes: int = 100,
    seed: int = 10_000,
    workers: int = 2,
    env_fn: EnvFn = DEFAULT_ENV,
    retries: int = 2,
    progress: bool = True,
) -> list[dict[str, Any]]:
    """Runs every policy on the same seeds in worker processes, each of which steps up to 4 environments in turn.

    A worker uses its environments again, so an episode must depend on the seed of ``reset`` alone once an environment
    was reset before. The Ant's does; its physics is restored bit for bit.

    Args:
        policies: name -> picklable callable, observation -> action (for batches see
            :func:`~torchrl_tsallis.evaluation.episodes.run_episodes`), or an actor's state for
            :meth:`MeanPolicy.from_actor_state`.
        episodes: episodes a policy (100, section V-B); episode i is seeded ``seed + i`` for every policy.
        seed: first seed (10000).
        workers: processes, each with one thread (2); 0 runs in this process.
        env_fn: ``"module:function"`` or a picklable callable.
        retries: how often an episode is done again after its worker died (2).
        progress: show a bar, if tqdm is installed.

    Returns:
        Rows ``{"policy", "episode", "seed", "return", "length"}`` by policy and episode; they do not depend on
        the number of workers, to the last bit.

    Raises:
        ValueError: if nothing is to be run or a policy cannot be pickled.
        RuntimeError: if an episode fails or keeps killing its worker; the message names it.

    Examples:
        >>> evaluate_policies({"zero": np.zeros_like}, episodes=0)
        Traceback (most recent call last):
        ...
        ValueError: need at least one policy and one episode, got 1 policies, episodes=0
    """
    if not policies or episodes < 1:
        raise ValueError(f"need at least one policy and one episode, got {len(policies)} policies, {episodes=}")
    if workers < 0 or retries < 0:
        raise ValueError(f"workers and retries must not be negative, got {workers=}, {retries=}")
    ready: dict[str, Policy] = {
        name: p if callable(p) else MeanPolicy.from_actor_state(p) for name, p in policies.items()
    }
    tasks = [(name, episode) for name in ready for episode in range(episodes)]
    # As many groups a policy as keep all workers busy to the end, if episodes last equally long.
    count = max(workers, 1) * -(-episodes // (GROUP * max(workers, 1)))
    parts = np.array_split(np.arange(episodes), min(count, episodes))
    groups = [[(name, int(episode)) for episode in part] for name in ready for part in parts]
    done: dict[Task, tuple[float, int]] = {}
    with _bar(len(tasks), progress) as tick:
        if workers == 0:
            try:
                _start(ready, env_fn, seed)
                for group in groups:
                    done.update(_work(group))
                    tick(len(group))
            finally:
                _stop()
        else:
            for name, policy in ready.items():
                try:
                    pickle.dumps(policy)
                except (pickle.PicklingError, AttributeError, TypeError) as error:
                    raise ValueError(f"policy {name!r} cannot be pickled ({error}): define it in a module") from error
            for group, results in _in_workers(groups, (ready, env_fn, seed), workers, retries):
                done.update(results)
                tick(len(group))
    return [
        {"policy": t[0], "episode": t[1], "seed": seed + t[1], "return": done[t][0], "length": done[t][1]}
        for t in tasks
    ]


def _start(policies: dict[str, Policy], env_fn: EnvFn, seed: int) -> None:
    """Keeps in a worker what its episodes share."""
    _WORKER.update(policies=policies, env_fn=env_fn, seed=seed, envs=[])


def _stop() -> None:
    """Closes the environments of this process."""
    for env in _WORKER.pop("envs", []):
        env.close()
    _WORKER.clear()


def _work(group: list[Task]) -> dict[Task, tuple[float, int]]:
    """Runs episodes of one policy together; an error names the one that failed."""
    name, first, envs = group[0][0], _WORKER["seed"], _WORKER["envs"]
    seeds = [first + episode for _, episode in group]
    try:
        while len(envs) < len(group):
            envs.append(make_environment(_WORKER["env_fn"], seeds[len(envs)]))
        return dict(zip(group, run_episodes(_WORKER["policies"][name], envs, seeds), strict=True))
    except EpisodeError as failure:
        seed, error = failure.seed, failure.__cause__
        raise RuntimeError(f"policy {name!r}, episode {seed - first} (seed {seed}) failed: {error!r}") from error


def _in_workers(
    groups: list[list[Task]], shared: tuple[Any, ...], workers: int, retries: int
) -> Iterator[tuple[list[Task], dict[Task, tuple[float, int]]]]:
    """Runs the groups; the episodes in flight when a worker dies are tried again one at a time, to find the culprit."""
    try:
        yield from finished_jobs(
            _work,
            groups,
            workers=workers,
            retries=retries,
            split=lambda group: [[task] for task in group],
            initializer=_start,
            initargs=shared,
        )
    except WorkerDiedError as error:
        names = ", ".join(f"{name!r} episode {episode}" for group in error.jobs for name, episode in group)
        raise RuntimeError(
            f"the worker process died {retries + 1} times on {names}: check memory, and run it with "
            "workers=0 to see the cause"
        ) from error


@contextmanager
def _bar(total: int, show: bool) -> Iterator[Callable[[int], Any]]:
    """Yields a function that advances the progress bar."""
    try:
        from tqdm import tqdm
    except ImportError:
        show = False
    if not show:
        yield lambda _: None
        return
    with tqdm(total=total, unit="episode", desc="evaluate") as bar:
        yield bar.update
