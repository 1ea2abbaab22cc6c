"""Throughput of stacked training against one run after the other with TorchRL's ``Trainer``, ``BCLoss`` and Adam.

Same network, data and batch size. Prints member-steps per second of both, their ratio, and the time over the floor that
the matrix products alone would need at the machine's measured rate::

    python benchmarks/bench_stacked.py --members 24 --threads 1
"""

from __future__ import annotations

import argparse
import statistics
import time
import warnings
from collections.abc import Callable

import torch
from tensordict import TensorDict
from torchrl._utils import logger as torchrl_logger
from torchrl.objectives import BCLoss

from torchrl_tsallis import AdaTerm, CATSoftUpdate, QTuner, TsallisBCLoss
from torchrl_tsallis.data import make_replay_buffer, make_stacked_replay_buffer
from torchrl_tsallis.modules import make_policy
from torchrl_tsallis.trainers import keep_freed_memory, make_offline_trainer

OBSERVATION, ACTION, HIDDEN, BATCH, ROWS = 28, 8, 100, 256, 29_970
WEIGHTS = OBSERVATION * HIDDEN + HIDDEN * HIDDEN + HIDDEN * 2 * ACTION
#: Of a member-step: forward, backward (twice that, but for the observations' gradient), and the target's forward.
FLOP = 2 * BATCH * (4 * WEIGHTS - OBSERVATION * HIDDEN)


def single(data: TensorDict) -> Callable[[int], None]:
    """Steps of TorchRL's trainer with BCLoss and Adam."""
    loss = BCLoss(make_policy(OBSERVATION, ACTION))
    buffer, optimizer = make_replay_buffer(data, batch_size=BATCH), torch.optim.Adam(loss.parameters())

    def run(steps: int) -> None:
        make_offline_trainer(loss, buffer, optimizer, steps=steps, log_every=steps, progress=False).train()

    return run


def stacked(data: TensorDict, members: int, gamma_mix: float | str, compiled: bool) -> Callable[[int], None]:
    """Steps of the proposal, or of another method, for all members at once."""
    loss = TsallisBCLoss([make_policy(OBSERVATION, ACTION) for _ in range(members)], gamma_mix=gamma_mix)
    optimizer = AdaTerm(loss.parameters(), batch_dims=1)
    updater = CATSoftUpdate(loss) if loss.needs_target else None
    tuner = QTuner(loss)
    buffer = make_stacked_replay_buffer(data, batch_size=BATCH, seeds=range(members))
    if compiled:
        loss.compile()

    def run(steps: int) -> None:
        options = {"steps": steps, "log_every": steps, "progress": False}
        make_offline_trainer(loss, buffer, optimizer, updater=updater, tuner=tuner, **options).train()

    return run


def gemm_rate(members: int, clock: Callable[[], float]) -> float:
    """FLOP a second of the batched product of the hidden layer, by the clock of the other measurements."""
    x, w = torch.randn(members, BATCH, HIDDEN), torch.randn(members, HIDDEN, HIDDEN)
    seconds = [timed(lambda: [torch.bmm(x, w) for _ in range(10)], clock) / 10 for _ in range(15)]
    return 2 * members * BATCH * HIDDEN * HIDDEN / statistics.median(seconds)


def timed(function: Callable[[], object], clock: Callable[[], float] = time.process_time) -> float:
    """Seconds of a call."""
    start = clock()
    function()
    return clock() - start


def main() -> None:
    """Measures both in turn."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--members", type=int, default=24)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--compile", action="store_true", help="torch.compile the loss (takes a minute)")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    keep_freed_memory()  # of both kinds of runs
    warnings.simplefilter("ignore")  # BCLoss warns of its own annotations
    torchrl_logger.setLevel("ERROR")
    torch.manual_seed(0)
    data = TensorDict({"observation": torch.randn(ROWS, OBSERVATION), "action": torch.randn(ROWS, ACTION)}, [ROWS])
    clock = time.process_time if args.threads == 1 else time.perf_counter
    runs = {
        "Trainer + BCLoss + Adam, one by one": (single(data), 1, 5 * args.steps),
        "stacked, proposal": (stacked(data, args.members, "adaptive", args.compile), args.members, args.steps),
        "stacked, gamma = 0": (stacked(data, args.members, 0.0, args.compile), args.members, args.steps),
    }
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for repeat in range(args.repeats + 1):  # the first warms up
        for name, (run, members, steps) in runs.items():
            value = timed(lambda run=run, steps=steps: run(steps), clock) / (steps * members)
            if repeat:
                seconds[name].append(value)
    floor = FLOP / gemm_rate(args.members, clock)
    base = statistics.median(next(iter(seconds.values())))
    print(f"floor {1e3 * floor:.3f} ms: {FLOP / 1e6:.1f} MFLOP a member-step at {1e-9 * FLOP / floor:.0f} GFLOP/s")
    for name, values in seconds.items():
        value = statistics.median(values)
        print(
            f"{name:36} {1e3 * value:6.3f} ms a member-step, {1 / value:6.0f} a second, "
            f"{base / value:5.2f} times the first, {value / floor:5.2f} times the floor"
        )


if __name__ == "__main__":
    main()
