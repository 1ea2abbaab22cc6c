"""Parallel evaluation of deterministic policies: raw returns of every episode, on common seeds."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import pickle
import sys
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

import numpy as np

from torchrl_tsallis.evaluation.mean_policy import MeanPolicy

Policy = Callable[[np.ndarray], np.ndarray]
Task = tuple[str, int]
DEFAULT_ENV = "torchrl_tsallis.envs:make_ant"
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
_WORKER: dict[str, Any] = {}


def resolve(env_fn: str | Callable[[], Any]) -> Callable[..., Any]:
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


def run_episode(policy: Policy, env_fn: str | Callable[[], Any], seed: int) -> tuple[float, int]:
    """Runs one episode in an environment of its own.

    A fresh environment makes the result a function of policy and seed alone. It is reset once and thrown away
    first, because PyBullet's first episode differs: the floor joins the scene's parts only after that reset.

    Args:
        policy: maps an observation to an action, which is clipped to the action space.
        env_fn: makes a Gymnasium environment.
        seed: given to ``reset``.

    Returns:
        The sum of rewards and the number of steps.

    Raises:
        ValueError: if the policy gives a wrong shape or a number that is not finite.
    """
    env = resolve(env_fn)()
    try:
        env.reset(seed=seed)
        observation, _ = env.reset(seed=seed)
        low, high = env.action_space.low, env.action_space.high
        total, length, done = 0.0, 0, False
        while not done:
            action = np.asarray(policy(observation))
            if action.shape != low.shape or not np.isfinite(action).all():
                raise ValueError(f"step {length}: need a finite action of shape {low.shape}, got {action}")
            action = np.clip(action, low, high).astype(low.dtype)
            observation, reward, terminated, truncated, _ = env.step(action)
            total, length, done = total + float(reward), length + 1, bool(terminated or truncated)
        return total, length
    finally:
        env.close()


def evaluate_policies(
    policies: Mapping[str, Mapping[str, Any] | Policy],
    *,
    episodes: int = 100,
    seed: int = 10_000,
    workers: int = 2,
    env_fn: str | Callable[[], Any] = DEFAULT_ENV,
    retries: int = 2,
    progress: bool = True,
) -> list[dict[str, Any]]:
    """Runs every policy on the same seeds in worker processes.

    Args:
        policies: name -> picklable callable, or an actor's state for :meth:`MeanPolicy.from_actor_state`.
        episodes: episodes a policy (100, section V-B); episode i is seeded ``seed + i`` for every policy.
        seed: first seed (10000).
        workers: processes, each with one thread (2); 0 runs in this process.
        env_fn: ``"module:function"`` or a picklable callable.
        retries: how often an episode is done again after its worker died (2).
        progress: show a bar, if tqdm is installed.

    Returns:
        Rows ``{"policy", "episode", "seed", "return", "length"}`` by policy and episode; they do not depend on
        the number of workers.

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
    done: dict[Task, tuple[float, int]] = {}
    with _bar(len(tasks), progress) as tick, _one_thread():
        if workers == 0:
            _start(ready, env_fn, seed)
            for task in tasks:
                done[task] = _work(task)
                tick()
        else:
            for name, policy in ready.items():
                try:
                    pickle.dumps(policy)
                except (pickle.PicklingError, AttributeError, TypeError) as error:
                    raise ValueError(f"policy {name!r} cannot be pickled ({error}): define it in a module") from error
            _run_pool(tasks, (ready, env_fn, seed), workers, retries, done, tick)
    return [
        {"policy": t[0], "episode": t[1], "seed": seed + t[1], "return": done[t][0], "length": done[t][1]}
        for t in tasks
    ]


def _start(policies: dict[str, Policy], env_fn: str | Callable[[], Any], seed: int) -> None:
    """Keeps in a worker what its episodes share."""
    _WORKER.update(policies=policies, env_fn=env_fn, seed=seed)
    if multiprocessing.parent_process() is not None and "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


def _work(task: Task) -> tuple[float, int]:
    """Runs one episode; an error names it."""
    name, episode = task
    seed = _WORKER["seed"] + episode
    try:
        return run_episode(_WORKER["policies"][name], _WORKER["env_fn"], seed)
    except Exception as error:
        raise RuntimeError(f"policy {name!r}, episode {episode} (seed {seed}) failed: {error!r}") from error


def _run_pool(
    tasks: list[Task], shared: tuple[Any, ...], workers: int, retries: int, done: dict, tick: Callable[[], Any]
) -> None:
    """Runs the tasks; those in flight when a worker dies are tried again one at a time, to find the culprit."""
    queue, suspects, deaths = deque(tasks), deque[Task](), Counter[Task]()
    context = multiprocessing.get_context("spawn")
    while queue or suspects:
        pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_start, initargs=shared)
        flying: dict[Future, Task] = {}
        try:
            while queue or suspects or flying:
                source, room = (suspects, 1) if suspects else (queue, workers)
                while source and len(flying) < room:
                    task = source.popleft()
                    try:
                        flying[pool.submit(_work, task)] = task
                    except BrokenProcessPool:
                        source.appendleft(task)
                        raise
                for future in wait(flying, return_when=FIRST_COMPLETED).done:
                    done[flying[future]] = future.result()
                    del flying[future]
                    tick()
        except BrokenProcessPool as error:
            deaths.update(flying.values())
            lost = [task for task in flying.values() if deaths[task] > retries]
            if lost:
                names = ", ".join(f"{name!r} episode {episode}" for name, episode in lost)
                raise RuntimeError(
                    f"the worker process died {retries + 1} times on {names}: check memory, and run it with "
                    "workers=0 to see the cause"
                ) from error
            suspects.extend(flying.values())
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Lets processes started inside use one thread each."""
    saved = {key: os.environ.get(key) for key in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for key, value in saved.items():
            if value is None:
                os.environ.pop(key, None)
            else:
                os.environ[key] = value


@contextmanager
def _bar(total: int, show: bool) -> Iterator[Callable[[], Any]]:
    """Yields a function that advances the progress bar."""
    try:
        from tqdm import tqdm
    except ImportError:
        show = False
    if not show:
        yield lambda: None
        return
    with tqdm(total=total, unit="episode", desc="evaluate") as bar:
        yield bar.update
