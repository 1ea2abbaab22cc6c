"""Throughput of stacked training on a GPU over the number of members, against its floor.

The paper's proposal, the peak rating and behavioral cloning, with TorchRL's trainer and the data on the device; member
steps a second, and the time over the larger of two floors: the matrix products at the device's measured rate, and the
bytes that a step has to move at its measured bandwidth. Writes a row a measurement::

    python benchmarks/bench_gpu.py --out docs/results/gpu.csv
    python benchmarks/bench_gpu.py --device cpu --members 1 8 --steps 20
"""

from __future__ import annotations

import argparse
import csv
import itertools
import platform
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from bench_stacked import ACTION, BATCH, FLOP, HIDDEN, OBSERVATION, ROWS, WEIGHTS
from tensordict import TensorDict
from torchrl._utils import logger as torchrl_logger

from torchrl_tsallis import AdaTerm, CATSoftUpdate, PeakRating, TsallisBCLoss
from torchrl_tsallis.data import make_stacked_replay_buffer
from torchrl_tsallis.modules import make_policy
from torchrl_tsallis.trainers import make_offline_trainer

#: Of a member-step, in a program that keeps what it can: a batch; activations once written and once read; parameters,
#: gradients, AdaTerm's three statistics and the target, each read and written.
BYTES = 4 * (BATCH * (OBSERVATION + ACTION + 2 * (2 * HIDDEN + 2 * ACTION)) + 12 * WEIGHTS)
#: Forward and backward alone, where no target is asked.
FLOP_ALONE = FLOP - 2 * BATCH * WEIGHTS
METHODS = ("proposal", "peak", "bc")
COLUMNS = ("device", "torch", "method", "form", "members", "ms_a_step", "member_steps_a_second", "floor_ms",
           "times_floor", "peak_mib")  # fmt: skip


def make_run(method: str, members: int, form: str, data: TensorDict, device: torch.device) -> Callable[[int], None]:
    """Steps of a method for all members at once."""
    torch.compiler.reset()
    actors = [make_policy(OBSERVATION, ACTION) for _ in range(members)]
    if method == "peak":
        loss = TsallisBCLoss(actors, rating=PeakRating())
    else:
        settings = {"q": 1.0, "gamma_mix": 0.0} if method == "bc" else {"gamma_mix": "adaptive"}
        loss = TsallisBCLoss(actors, **settings)
    loss = loss.to(device)
    if form != "eager":
        loss.compile(mode="reduce-overhead")
    optimizer = AdaTerm(loss.parameters(), batch_dims=1)
    updater = CATSoftUpdate(loss) if loss.needs_target else None
    tuner = None if method == "bc" else loss.rating_module.tuner()(loss)
    buffer = make_stacked_replay_buffer(data, batch_size=BATCH, seeds=range(members), device=device)

    def run(steps: int) -> None:
        options = {"steps": steps, "log_every": steps, "progress": False}
        make_offline_trainer(loss, buffer, optimizer, updater=updater, tuner=tuner, **options).train()

    return run


@contextmanager
def stopwatch(device: torch.device) -> Iterator[list[float]]:
    """Seconds of what is done within, the device's work included."""
    out: list[float] = []
    if device.type == "cuda":
        torch.cuda.synchronize()
    start = time.perf_counter()
    yield out
    if device.type == "cuda":
        torch.cuda.synchronize()
    out.append(time.perf_counter() - start)


def rates(members: int, device: torch.device) -> tuple[float, float]:
    """Floating-point operations a second of the hidden layer's product, and bytes a second of a large copy."""
    x, w = (torch.randn(members, *shape, device=device) for shape in ((BATCH, HIDDEN), (HIDDEN, HIDDEN)))
    source = torch.randn(2**28 if device.type == "cuda" else 2**24, device=device)
    target = torch.empty_like(source)
    best = []
    for function, amount in (
        (lambda: torch.bmm(x, w), 2 * members * BATCH * HIDDEN * HIDDEN),
        (lambda: target.copy_(source), 2 * source.nbytes),
    ):
        function()
        seconds = []
        for _ in range(5):
            with stopwatch(device) as took:
                for _ in range(10):
                    function()
            seconds.append(took[0] / 10)
        best.append(amount / min(seconds))
    return best[0], best[1]


def main() -> None:
    """Measures what is asked for, and writes each row at once."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--members", type=int, nargs="+", default=[1, 8, 24, 96, 240, 480, 960])
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument("--forms", nargs="+", choices=("eager", "graphs"), default=("eager", "graphs"))
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--limit", type=float, default=600.0, help="seconds after which no measurement is begun")
    parser.add_argument("--out", type=Path, default=Path("gpu.csv"))
    args = parser.parse_args()
    device, begun = torch.device(args.device), time.monotonic()
    warnings.simplefilter("ignore")
    torchrl_logger.setLevel("ERROR")
    torch.manual_seed(0)
    data = TensorDict({"observation": torch.randn(ROWS, OBSERVATION), "action": torch.randn(ROWS, ACTION)}, [ROWS])
    name = torch.cuda.get_device_name() if device.type == "cuda" else platform.processor() or platform.machine()
    operations, bandwidth = rates(max(args.members), device)
    print(f"{name}: {1e-12 * operations:.1f} TFLOP/s in the hidden layer, {1e-9 * bandwidth:.0f} GB/s")
    with open(args.out, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        for form, members, method in itertools.product(args.forms, args.members, args.methods):
            if time.monotonic() - begun > args.limit:
                print("the limit is reached: the rest is not measured")
                break
            if device.type == "cuda":
                torch.cuda.reset_peak_memory_stats()
            run = make_run(method, members, form, data, device)
            run(10)  # warms up
            seconds = []
            for _ in range(3):
                with stopwatch(device) as took:
                    run(args.steps)
                seconds.append(took[0] / args.steps)
            value = sorted(seconds)[1]
            flop = FLOP if method == "proposal" else FLOP_ALONE
            floor = members * max(flop / operations, BYTES / bandwidth)
            row = {"device": name, "torch": torch.__version__, "method": method, "form": form, "members": members}
            row |= {"ms_a_step": f"{1e3 * value:.3f}", "member_steps_a_second": f"{members / value:.0f}"}
            row |= {"floor_ms": f"{1e3 * floor:.4f}", "times_floor": f"{value / floor:.2f}"}
            row["peak_mib"] = f"{torch.cuda.max_memory_allocated() / 2**20:.0f}" if device.type == "cuda" else ""
            writer.writerow(row)
            file.flush()
            print(*row.values(), sep="  ", flush=True)


if __name__ == "__main__":
    main()
