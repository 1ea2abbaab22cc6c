"""Speed of the Ant environment and of the evaluator, as ratios.

One thread, CPU time, all in turn in one process (the evaluator's workers apart); the trajectory is that of a policy
which was cloned from a shipped expert and walks for the whole episode::

    OMP_NUM_THREADS=1 python benchmarks/bench_ant.py
"""

from __future__ import annotations

import resource
import statistics
import time
import warnings
from collections.abc import Callable

import gymnasium
import numpy as np
import pybullet
import pybullet_envs_gymnasium  # noqa: F401
import torch

from torchrl_tsallis.data import load_policy
from torchrl_tsallis.envs import make_ant
from torchrl_tsallis.evaluation import MeanPolicy, evaluate_policies
from torchrl_tsallis.evaluation.episodes import make_environment, run_episodes
from torchrl_tsallis.evaluation.rollouts import GROUP
from torchrl_tsallis.modules import make_policy

REPEATS, STEPS, SEED = 7, 1000, 10_000


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


def workers_cpu(policy: MeanPolicy, episodes: int) -> tuple[float, int]:
    """CPU seconds of two worker processes from their start to their end, and the steps that they made."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    rows = evaluate_policies({"clone": policy}, episodes=episodes, seed=SEED, workers=2, progress=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return cpu, sum(row["length"] for row in rows)


def main() -> None:
    """Measures everything in turn."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    policy = clone_expert()
    envs = [make_environment(make_ant, SEED) for _ in range(GROUP)]
    env, bare = make_environment(make_ant, SEED), make_environment(make_ant, SEED)
    package = make_environment(lambda: gymnasium.make("AntBulletEnv-v0"), SEED)
    actions: list[np.ndarray] = []
    observation, _ = env.reset(seed=SEED)
    for _ in range(STEPS):
        actions.append(np.clip(policy(observation), -1, 1))
        observation, _, terminated, _, _ = env.step(actions[-1])
        if terminated:
            raise RuntimeError(f"the cloned policy fell after {len(actions)} steps: clone it with more updates")

    def stepping(target: gymnasium.Env) -> Callable[[], int]:
        def run() -> int:
            target.reset(seed=SEED)
            for action in actions:
                target.step(action)
            return STEPS

        return run

    def physics() -> int:
        bare.reset(seed=SEED)
        ant, client = bare.unwrapped._ant, bare.unwrapped._client
        joints, mode = bare.unwrapped._joints, pybullet.TORQUE_CONTROL
        for action in actions:
            forces = [250.0 * a for a in action.tolist()]
            pybullet.setJointMotorControlArray(ant, joints, mode, forces=forces, physicsClientId=client)
            pybullet.stepSimulation(physicsClientId=client)
        return STEPS

    def evaluating(policy: Callable, count: int) -> Callable[[], int]:
        return lambda: sum(length for _, length in run_episodes(policy, envs, [SEED] * count))

    runs: dict[str, Callable[[], int]] = {
        "physics": physics,
        "ours": stepping(env),
        "package": stepping(package),
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
    cost = {name: statistics.median(values) for name, values in times.items()}
    for name, value in cost.items():
        print(f"{name:28} {1e6 * value:6.1f} us a step (CPU)")
    few, many = workers_cpu(policy, 4), workers_cpu(policy, 68)
    slope = (many[0] - few[0]) / (many[1] - few[1])
    start = few[0] - slope * few[1]
    print(
        f"{'evaluate_policies, 2 workers':28} {1e6 * slope:6.1f} us a step (CPU), after {start / 2:.1f} s a worker to start"
    )
    print(f"ours / package           {cost['package'] / cost['ours']:.2f} (at least 2 wanted)")
    print(f"ours / physics alone     {cost['physics'] / cost['ours']:.2f} (at least 0.65 wanted, 0.75 hoped for)")
    print(
        f"evaluator / ours         {cost['ours'] / cost['evaluator']:.2f} (at least 0.85 wanted), {GROUP} environments"
    )
    print(f"  one environment        {cost['ours'] / cost['evaluator, one environment']:.2f}, one observation a call")
    print(f"  2 worker processes     {cost['ours'] / slope:.2f} a core, without their start")


if __name__ == "__main__":
    main()
