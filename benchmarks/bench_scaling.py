"""How training scales with the number of stacked members, and evaluation with workers and environments.

Prints, and draws into one picture: member-steps per second and memory over S, and episode steps per second over the
numbers of worker processes and of environments that a worker steps in turn. Each number is measured in a process of its
own::

    python benchmarks/bench_scaling.py --members 1 2 4 8 16 24 48 96 --workers 1 2 4 --environments 1 2 4 8
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path


def train(members: int, steps: int, threads: int) -> dict[str, float]:
    """Member-steps per second of the proposal, and the memory that it adds to the process."""
    import torch
    from bench_stacked import ACTION, OBSERVATION, ROWS, stacked, timed
    from tensordict import TensorDict
    from torchrl._utils import logger as torchrl_logger

    from torchrl_tsallis.trainers import keep_freed_memory

    torch.set_num_threads(threads)
    keep_freed_memory(16)  # asks for little at once, so that the peak says what is needed
    torchrl_logger.setLevel("ERROR")
    torch.manual_seed(0)
    data = TensorDict({"observation": torch.randn(ROWS, OBSERVATION), "action": torch.randn(ROWS, ACTION)}, [ROWS])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    run = stacked(data, members, "adaptive", compiled=False)
    run(2)
    clock = time.process_time if threads == 1 else time.perf_counter
    seconds = min(timed(lambda: run(steps), clock) for _ in range(3))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {"rate": members * steps / seconds, "megabytes": (peak - before) / 1024}


def evaluate(workers: int, environments: int, episodes: int) -> dict[str, float]:
    """Environment steps per second of an expert, by the wall clock, after the workers' start."""
    from torchrl_tsallis.data import load_policy
    from torchrl_tsallis.envs import make_ant
    from torchrl_tsallis.evaluation import evaluate_policies, rollouts

    rollouts.GROUP = environments  # of this process alone: with workers, they get it by their groups' sizes
    policy = load_policy("expert_0")  # walks for most of the 1000 steps
    # The same start, with one episode a worker, is taken off.
    spent = []
    lengths = 0
    for count in (workers or 1, (workers or 1) + episodes):
        start = time.perf_counter()
        rows = evaluate_policies({"expert": policy}, env_fn=make_ant, episodes=count, workers=workers, progress=False)
        spent.append(time.perf_counter() - start)
        lengths = sum(row["length"] for row in rows) - lengths
    return {"rate": lengths / max(spent[1] - spent[0], 1e-9)}


def measured(kind: str, **arguments: int) -> dict[str, float]:
    """A measurement in a process of its own."""
    command = [sys.executable, __file__, "--one", json.dumps({"kind": kind, **arguments})]
    environment = os.environ | {"OMP_NUM_THREADS": str(arguments.get("threads", 1))}
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=environment)
    return json.loads(done.stdout.splitlines()[-1])


def draw(training: dict[int, dict[str, float]], evaluation: dict[int, dict[int, float]], path: Path) -> None:
    """One picture of all."""
    from matplotlib.figure import Figure

    from torchrl_tsallis.jobs import atomic_path

    figure = Figure(figsize=(10.5, 3.2), dpi=150, layout="constrained")
    panels = figure.subplots(1, 3)
    for axes, name, label in (
        (panels[0], "rate", "member-steps a second"),
        (panels[1], "megabytes", "memory added (MB)"),
    ):
        axes.plot(list(training), [values[name] for values in training.values()], "o-")
        axes.set_xscale("log", base=2)
        axes.set_xticks(list(training), [str(members) for members in training])
        axes.set_xlabel("stacked members S")
        axes.set_ylabel(label)
    for workers, rates in evaluation.items():
        panels[2].plot(list(rates), list(rates.values()), "o-", label=f"{workers} workers")
    panels[2].set_xlabel("environments a worker")
    panels[2].set_ylabel("environment steps a second")
    if evaluation:
        panels[2].legend(frameon=False, fontsize=8)
    for axes in panels:
        axes.set_ylim(bottom=0)
        axes.spines[["top", "right"]].set_visible(False)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")


def main() -> None:
    """Measures and draws."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--members", type=int, nargs="*", default=[1, 2, 4, 8, 16, 24, 48, 96])
    parser.add_argument("--workers", type=int, nargs="*", default=[1, 2])
    parser.add_argument("--environments", type=int, nargs="*", default=[1, 2, 4, 8])
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--episodes", type=int, default=64, help="many: the start, which is taken off, varies")
    parser.add_argument("--threads", type=int, default=1, help="of the training; with 1, CPU time is measured")
    parser.add_argument("--output", type=Path, default=Path("outputs/bench_scaling.png"))
    parser.add_argument("--one", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        arguments = json.loads(args.one)
        print(json.dumps({"train": train, "evaluate": evaluate}[arguments.pop("kind")](**arguments)))
        return
    training: dict[int, dict[str, float]] = {}
    for members in args.members:
        result = training[members] = measured("train", members=members, steps=args.steps, threads=args.threads)
        print(f"S = {members:3}: {result['rate']:7.0f} member-steps a second, {result['megabytes']:6.0f} MB")
    evaluation: dict[int, dict[int, float]] = {}
    for workers in args.workers:
        for environments in args.environments:
            rate = measured("evaluate", workers=workers, environments=environments, episodes=args.episodes)["rate"]
            evaluation.setdefault(workers, {})[environments] = rate
            print(f"{workers} workers, {environments} environments each: {rate:7.0f} environment steps a second")
    draw(training, evaluation, args.output)
    print(f"picture in {args.output}")


if __name__ == "__main__":
    main()
