"""Speed of the Ant environment and of the evaluator, as ratios.

One thread a process, CPU time, all in turn; the trajectory is that of a policy which was cloned from a shipped expert
and walks for the whole episode. The ratios depend on the processor: on how fast it computes the physics (PyBullet's own
code, the same for all) compared with Python::

    OMP_NUM_THREADS=1 python benchmarks/bench_ant.py
"""

from __future__ import annotations

import statistics
import time
import warnings
from collections.abc import Callable
from functools import partial

import gymnasium
import numpy as np
import torch

from torchrl_tsallis.data import load_policy
from torchrl_tsallis.envs import make_ant
from torchrl_tsallis.evaluation import MeanPolicy, evaluate_policies
from torchrl_tsallis.evaluation.episodes import make_environment, run_episodes
from torchrl_tsallis.evaluation.rollouts import GROUP
from torchrl_tsallis.jobs import finished_jobs
from torchrl_tsallis.modules import make_policy

REPEATS, STEPS, SEED = 5, 1000, 10_000


class Alone:
    """Hides that a policy can act on a batch."""

    def __init__(self, policy: MeanPolicy) -> None:
        self.policy = policy

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Acts on one observation."""
        return self.policy(observation)


def clone_expert(episodes: int = 6, updates: int = 2000) -> MeanPolicy:
    """Imitates an expert for some seconds, so that the evaluated network is the imitators'."""
    expert, env, rng = load_policy("expert_0"), make_environment(make_ant, 0), np.random.default_rng(0)
    rows = []
    for seed in range(episodes):
        observation, over = env.reset(seed=seed)[0], False
        while not over:
            rows.append((observation, expert(observation)))
            observation, _, terminated, truncated, _ = env.step(expert.act(observation, rng, 0.2))
            over = terminated or truncated
    env.close()
    inputs, targets = (torch.from_numpy(np.stack(column)) for column in zip(*rows, strict=True))
    torch.manual_seed(0)
    actor = make_policy(28, 8)
    network = actor.module[0].module
    optimizer = torch.optim.Adam(actor.parameters(), lr=2e-3)
    for update in range(updates):
        if update == 3 * updates // 4:
            optimizer.param_groups[0]["lr"] = 3e-4
        batch = torch.randint(len(rows), (256,))
        (network(inputs[batch])[0] - targets[batch]).square().mean().backward()
        optimizer.step()
        optimizer.zero_grad()
    return MeanPolicy.from_actor_state(actor.state_dict())


def record(policy: MeanPolicy) -> list[np.ndarray]:
    """Actions of a whole episode, ``STEPS`` of ``[8]``."""
    env, actions = make_environment(make_ant, SEED), []
    observation, _ = env.reset(seed=SEED)
    for _ in range(STEPS):
        actions.append(np.clip(policy(observation), -1, 1))
        observation, _, terminated, _, _ = env.step(actions[-1])
        if terminated:
            raise RuntimeError(f"the cloned policy fell after {len(actions)} steps: clone it with more updates")
    env.close()
    return actions


def stepping(env: gymnasium.Env, actions: list[np.ndarray]) -> Callable[[], int]:
    """An episode of given actions; returns its steps."""

    def run() -> int:
        env.reset(seed=SEED)
        for action in actions:
            env.step(action)
        return len(actions)

    return run


def physics(env: gymnasium.Env, actions: list[np.ndarray]) -> Callable[[], int]:
    """The same episode, with one torque call and one step of the physics a step and nothing else."""
    import pybullet

    ant, client, joints = env.unwrapped._ant, env.unwrapped._client, env.unwrapped._joints

    def run() -> int:
        env.reset(seed=SEED)
        for action in actions:
            forces = [250.0 * a for a in action.tolist()]
            pybullet.setJointMotorControlArray(
                ant, joints, pybullet.TORQUE_CONTROL, forces=forces, physicsClientId=client
            )
            pybullet.stepSimulation(physicsClientId=client)
        return len(actions)

    return run


def measure(policy: MeanPolicy, actions: list[np.ndarray]) -> dict[str, float]:
    """Median CPU time a step (s) of everything, measured in turn."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    envs = [make_environment(make_ant, SEED) for _ in range(GROUP)]
    package = make_environment(lambda: gymnasium.make("pybullet_envs_gymnasium:AntBulletEnv-v0"), SEED)

    def evaluating(policy: Callable, count: int) -> Callable[[], int]:
        return lambda: sum(episode.length for episode in run_episodes(policy, envs, [SEED] * count))

    runs = {
        "physics alone": physics(make_environment(make_ant, SEED), actions),
        "ours": stepping(make_environment(make_ant, SEED), actions),
        "package": stepping(package, actions),
        "evaluator": evaluating(policy, GROUP),
        "evaluator, one environment": evaluating(Alone(policy), 1),
    }
    times: dict[str, list[float]] = {name: [] for name in runs}
    for repeat in range(REPEATS + 1):  # the first warms up
        for name, run in runs.items():
            start = time.process_time()
            steps = run()
            if repeat:
                times[name].append((time.process_time() - start) / steps)
    return {name: statistics.median(values) for name, values in times.items()}


def show(title: str, cost: dict[str, float]) -> None:
    """Prints times and ratios."""
    print(title)
    for name, value in cost.items():
        print(f"  {name:28} {1e6 * value:6.1f} us a step (CPU)")
    ours = cost["ours"]
    print(f"  speed: ours / package        {cost['package'] / ours:.2f} (at least 2 wanted)")
    print(f"         ours / physics alone  {cost['physics alone'] / ours:.2f} (at least 0.65 wanted, 0.75 hoped for)")
    print(f"         evaluator / ours      {ours / cost['evaluator']:.2f} (at least 0.85 wanted)")
    print(f"         one environment       {ours / cost['evaluator, one environment']:.2f} (an observation a call)")


def main() -> None:
    """Measures one process, then two at once, then the start of the workers."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    policy = clone_expert()
    actions = record(policy)
    show("one process", measure(policy, actions))
    for _, result in finished_jobs(partial(measure, policy), [actions, actions], workers=2):
        show("one of two processes at once", result)
    before = time.perf_counter()
    evaluate_policies({"clone": policy}, env_fn=make_ant, episodes=2, workers=2, progress=False)
    print(f"evaluate_policies of 2 episodes on 2 workers: {time.perf_counter() - before:.1f} s, most of it their start")


if __name__ == "__main__":
    main()
