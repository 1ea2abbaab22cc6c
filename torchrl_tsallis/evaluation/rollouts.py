"""Parallel evaluation of deterministic policies: raw returns of every episode, on common seeds."""

from __future__ import annotations

import logging
import pickle
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from torchrl_tsallis._checks import check_flag
from torchrl_tsallis.evaluation.episodes import (
    MAX_STEPS,
    EnvFn,
    Episode,
    EpisodeError,
    checked_env_fn,
    make_environment,
    run_episodes,
)
from torchrl_tsallis.evaluation.interface import name_of
from torchrl_tsallis.evaluation.ownership import Policy, as_policy, left_as_found, set_evaluation
from torchrl_tsallis.evaluation.settings import whole_number
from torchrl_tsallis.jobs import WorkerDiedError, finished_jobs

Task = tuple[str, int]
#: Most episodes that a worker steps in turn; fewer batch the policy less, more crowd the processor's caches.
GROUP = 4
_WORKER: dict[str, Any] = {}
_LOGGER = logging.getLogger(__name__)


def evaluate_policies(
    policies: Mapping[str, Any],
    *,
    env_fn: EnvFn,
    episodes: int = 100,
    seed: int = 10_000,
    workers: int = 2,
    max_steps: int = MAX_STEPS,
    retries: int = 2,
    progress: bool = True,
) -> list[dict[str, Any]]:
    """Runs every policy on the same seeds in worker processes, each of which steps up to 4 environments in turn.

    A worker uses its environments again, so an episode must depend on the seed of ``reset`` alone once an environment
    was reset before, as one that restores its physics bit for bit.

    Networks are run in evaluation mode, whatever mode they are in; a policy with ``reset()`` begins each episode with a
    fresh copy. Modes, memories and the global random numbers are afterwards as they were, also after an error.

    Args:
        policies: name -> picklable callable, observation -> action (see
            :func:`~torchrl_tsallis.evaluation.episodes.run_episodes`); an actor of TorchRL, which becomes an
            :class:`~torchrl_tsallis.evaluation.ActorPolicy`; or an actor's state for
            :meth:`MeanPolicy.from_actor_state`.
        env_fn: ``"module:function"`` or a picklable callable that makes a Gymnasium environment.
        episodes: episodes a policy (100, section V-B); episode i is seeded ``seed + i`` for every policy.
        seed: first seed (10000).
        workers: processes, each with one thread (2); 0 runs in this process.
        max_steps: longest episode (10000). A warning is logged where it is reached.
        retries: how often an episode is done again after its worker died (2).
        progress: show a bar, if tqdm is installed.

    Returns:
        Rows ``{"policy", "episode", "seed", "return", "length"}`` by policy and episode; they do not depend on
        the number of workers, to the last bit. The row of an episode that was ended at ``max_steps``, instead of by its
        environment, also has ``"truncated": True``.

    Raises:
        ValueError: if nothing is to be run, a number is no whole one or too small, or policy or environment cannot be
            pickled.
        TypeError: if something is no policy or ``env_fn`` makes no environment.
        RuntimeError: if an episode fails or keeps killing its worker, or no worker can start; the message names it.

    Examples:
        >>> evaluate_policies({"zero": np.zeros_like}, env_fn="my_robot:make_env", episodes=0)
        Traceback (most recent call last):
        ...
        ValueError: episodes must be a whole number of at least 1, got episodes=0
    """
    if not isinstance(policies, Mapping) or not len(policies):
        raise ValueError(f"policies must be a mapping, name -> policy, of at least one; got {type(policies).__name__}")
    episodes, seed = whole_number("episodes", episodes, 1), whole_number("seed", seed, 0)
    workers, retries = whole_number("workers", workers, 0), whole_number("retries", retries, 0)
    check_flag("progress", progress)
    max_steps, env_fn = whole_number("max_steps", max_steps, 1), checked_env_fn(env_fn)
    ready: dict[str, Policy] = {name: as_policy(name, policy) for name, policy in policies.items()}
    tasks = [(name, episode) for name in ready for episode in range(episodes)]
    # As many groups a policy as keep all workers busy to the end, if episodes last equally long.
    count = max(workers, 1) * -(-episodes // (GROUP * max(workers, 1)))
    parts = np.array_split(np.arange(episodes), min(count, episodes))
    groups = [[(name, int(episode)) for episode in part] for name in ready for part in parts]
    done: dict[Task, Episode] = {}
    with _bar(len(tasks), progress) as tick, left_as_found(ready.values()):
        if workers == 0:
            try:
                _start(ready, env_fn, seed, max_steps)
                for group in groups:
                    done.update(_work(group))
                    tick(len(group))
            finally:
                _stop()
        else:
            pickled = [_dumped("env_fn", env_fn)]
            pickled += [_dumped(f"policy {name!r}", policy) for name, policy in ready.items()]
            for group, results in _in_workers(groups, (pickled, list(ready), seed, max_steps), workers, retries):
                done.update(results)
                tick(len(group))
    for name in ready:
        cut = sum(done[name, episode].cut for episode in range(episodes))
        if cut:
            _LOGGER.warning(
                "policy %r: %d of %d episodes were ended at max_steps=%d before their environment ended them; their "
                "rows are marked as truncated", name, cut, episodes, max_steps
            )  # fmt: skip
    rows = []
    for name, episode in tasks:
        total, length, truncated = done[name, episode]
        row = {"policy": name, "episode": episode, "seed": seed + episode, "return": total, "length": length}
        rows.append(row | ({"truncated": True} if truncated else {}))
    return rows


def _start(policies: dict[str, Policy], env_fn: EnvFn, seed: int, max_steps: int) -> None:
    """Keeps in a process what its episodes share."""
    _WORKER.update(policies=policies, env_fn=env_fn, seed=seed, max_steps=max_steps, envs=[])


def _dumped(what: str, value: Any) -> bytes:
    """Pickles what workers get."""
    try:
        return pickle.dumps(value)
    except Exception as error:  # pickle raises whatever the parts do
        raise ValueError(f"{what} cannot be pickled ({error}): define it in a module, or use workers=0") from error


def _start_worker(pickled: list[bytes], names: list[str], seed: int, max_steps: int) -> None:
    """Unpickles in a worker what its episodes share, ``env_fn`` first; what fails is told when there is work."""
    loaded: list[Any] = []
    for what, data in zip(["env_fn", *(f"policy {name!r}" for name in names)], pickled, strict=True):
        try:
            loaded.append(pickle.loads(data))
        except Exception as error:  # here it would end the process without a word to the main one
            _WORKER["failure"] = f"{what} cannot be loaded in a worker process ({type(error).__name__}: {error})"
            return
    set_evaluation(loaded[1:])  # networks that a function names are the worker's own, not sent to it
    _start(dict(zip(names, loaded[1:], strict=True)), loaded[0], seed, max_steps)


def _stop() -> None:
    """Closes the environments of this process."""
    for env in _WORKER.pop("envs", []):
        env.close()
    _WORKER.clear()


def _work(group: list[Task]) -> dict[Task, Episode]:
    """Runs episodes of one policy together; an error names the one that failed."""
    if "failure" in _WORKER:
        raise RuntimeError(f"{_WORKER['failure']}: define it in a module that a worker can import, or use workers=0")
    name, first, envs = group[0][0], _WORKER["seed"], _WORKER["envs"]
    seeds, policy = [first + episode for _, episode in group], _WORKER["policies"][name]
    try:
        while len(envs) < len(group):
            envs.append(make_environment(_WORKER["env_fn"], seeds[len(envs)]))
        return dict(zip(group, run_episodes(policy, envs, seeds, max_steps=_WORKER["max_steps"]), strict=True))
    except EpisodeError as failure:
        seed, error = failure.seed, failure.__cause__
        where = f" in {name_of(envs[0])}" if envs else ""
        raise RuntimeError(
            f"policy {name!r}, episode {seed - first} (seed {seed}){where} failed: {type(error).__name__}: {error}"
        ) from error


def _in_workers(
    groups: list[list[Task]], shared: tuple[Any, ...], workers: int, retries: int
) -> Iterator[tuple[list[Task], dict[Task, Episode]]]:
    """Runs the groups; the episodes in flight when a worker dies are tried again one at a time, to find the culprit."""
    try:
        yield from finished_jobs(
            _work,
            groups,
            workers=workers,
            retries=retries,
            split=lambda group: [[task] for task in group],
            initializer=_start_worker,
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
