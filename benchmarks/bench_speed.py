"""Every ratio of docs/speed.md in one run: CPU time of training against TorchRL's, on one thread, interleaved.

Prints the machine, MKL's kernel and the load first. A ratio is the median over the repeats, each of which measures all
contenders of a group in turn, with the quartiles beside it; with the native kernels built, each of ours is measured
without and with them::

    python benchmarks/bench_speed.py --out docs/results/speed.csv
    python benchmarks/bench_speed.py --groups stacked floor --methods proposal --members 1 8 24 96 --append --out FILE
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import os
import platform
import statistics
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import torch
from bench_adaterm import SHAPES
from bench_step import make_step, recurrent
from tensordict import TensorDict
from torchrl._utils import logger as torchrl_logger
from torchrl.objectives import BCLoss

from torchrl_tsallis import AdaTerm, CATSoftUpdate, PeakRating, TsallisBCLoss
from torchrl_tsallis.data import make_replay_buffer, make_stacked_replay_buffer
from torchrl_tsallis.jobs import atomic_path
from torchrl_tsallis.modules import make_policy
from torchrl_tsallis.trainers import keep_freed_memory, make_offline_trainer

OBSERVATION, ACTION = 28, 8
COLUMNS = [
    "group", "what", "kernels", "members", "batch", "width", "threads", "rows", "clock",
    "milliseconds", "first", "ratio", "low", "high", "repeats", "load", "machine", "mkl", "torch",
]  # fmt: skip
METHODS: dict[str, Callable[[], dict[str, Any]]] = {
    "bc": lambda: {"q": 1.0, "gamma_mix": 0.0},
    "peak": lambda: {"rating": PeakRating()},
    "proposal": lambda: {},
}
#: Contender: a function of one call, how many member-steps that is, and the kernels that it uses.
Contenders = dict[tuple[str, str], tuple[Callable[[], Any], float]]


@contextmanager
def kernels(name: str) -> Iterator[None]:
    """Inside, the native kernels are used or not; without them built there is nothing to choose."""
    with contextlib.nullcontext() if native() is None else native().used(name == "native"):
        yield


def native() -> Any:
    """The package of the native kernels, where it is built for this machine; else None."""
    try:
        from torchrl_tsallis import native as package
    except ImportError:
        return None
    return package if package.is_available() else None


def variants(names: list[str]) -> list[str]:
    """The kernels that can be measured."""
    return [name for name in names if name == "torch" or native() is not None]


def mkl_kernel() -> str:
    """What MKL says of the processor and the kernel that it takes on it; it tells that only while it multiplies."""
    code = "import torch; a = torch.ones(64, 64); a @ a"
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"MKL_VERBOSE": "1"}, capture_output=True, text=True, check=False
    )
    found = [line for line in done.stdout.splitlines() if "for Intel" in line]
    return found[0].partition(" for ")[2].partition(", Lnx")[0] if found else "no MKL, or one that does not tell"


def cpu_name() -> str:
    """The processor's name."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or "unknown"


def ratio(value: float, first: float) -> float:
    """How many times the first a time is.

    Raises:
        ValueError: for a time that is not positive, which says that the clock is too coarse for what was measured.
    """
    if not (value > 0 and first > 0):
        raise ValueError(f"no ratio of the times {value} and {first}: measure more steps at once")
    return value / first


def demonstrations(rows: int) -> TensorDict:
    """Random data of the Ant's size."""
    torch.manual_seed(0)
    return TensorDict({"observation": torch.randn(rows, OBSERVATION), "action": torch.randn(rows, ACTION)}, [rows])


def baseline(data: TensorDict, args: argparse.Namespace) -> Callable[[], None]:
    """Steps of TorchRL's trainer with BCLoss and Adam."""
    loss = BCLoss(make_policy(OBSERVATION, ACTION, hidden=(args.width,) * 2))
    buffer, optimizer = make_replay_buffer(data, batch_size=args.batch), torch.optim.Adam(loss.parameters())
    steps = 5 * args.steps
    return lambda: make_offline_trainer(loss, buffer, optimizer, steps=steps, log_every=steps, progress=False).train()


def stacked(data: TensorDict, method: str, args: argparse.Namespace) -> Callable[[], None]:
    """Steps of a method for all members at once, with all that belongs to it."""
    policies = [make_policy(OBSERVATION, ACTION, hidden=(args.width,) * 2) for _ in range(args.members)]
    loss = TsallisBCLoss(policies, **METHODS[method]())
    optimizer = AdaTerm(loss.parameters(), batch_dims=1)
    updater = CATSoftUpdate(loss) if loss.needs_target else None
    tuner = None if method == "bc" else loss.rating_module.tuner()(loss)
    buffer = make_stacked_replay_buffer(data, batch_size=args.batch, seeds=range(args.members))
    options: dict[str, Any] = {"steps": args.steps, "log_every": args.steps, "progress": False}
    return lambda: make_offline_trainer(loss, buffer, optimizer, updater=updater, tuner=tuner, **options).train()


def stacked_group(args: argparse.Namespace) -> Contenders:
    """Stacked members against runs of TorchRL's trainer, one after the other."""
    data = demonstrations(args.rows)
    out: Contenders = {("Trainer + BCLoss + Adam", "torch"): (baseline(data, args), 5 * args.steps)}
    for method in args.methods:
        for name in variants(args.kernels):
            out[f"{method}, stacked", name] = (stacked(data, method, args), args.steps * args.members)
    return out


def repeated(step: Callable[[TensorDict], None], batch: TensorDict, count: int) -> Callable[[], None]:
    """So many steps on copies of a batch, which TorchRL's losses write to."""

    def run() -> None:
        for _ in range(count):
            step(batch.copy())

    return run


def single_group(args: argparse.Namespace) -> Contenders:
    """One policy: a step with all that belongs to the method and its own optimizer, against BCLoss with Adam."""
    torch.manual_seed(0)
    size, hidden = args.batch, (args.width,) * 2
    batch = TensorDict({"observation": torch.randn(size, OBSERVATION), "action": torch.randn(size, ACTION)}, [size])
    plain = make_step(BCLoss(make_policy(OBSERVATION, ACTION, hidden=hidden)))
    out: Contenders = {("BCLoss + Adam", "torch"): (repeated(plain, batch, args.steps), args.steps)}
    for method in args.methods:
        for optimizer in (AdaTerm, torch.optim.Adam):
            for name in variants(args.kernels):
                loss = TsallisBCLoss(make_policy(OBSERVATION, ACTION, hidden=hidden), **METHODS[method]())
                step = make_step(loss, optimizer)
                out[f"{method} + {optimizer.__name__}", name] = (repeated(step, batch, args.steps), args.steps)
    return out


def recurrent_group(args: argparse.Namespace) -> Contenders:
    """The page-flipping policy with its prediction of the next observation, against BCLoss, both with Adam."""
    torch.manual_seed(0)
    steps, batch, count, _ = recurrent()
    return {(f"{name}, recurrent", "torch"): (repeated(step, batch, count), count) for name, step in steps.items()}


def optimizer_group(args: argparse.Namespace) -> Contenders:
    """AdaTerm against Adam(foreach), for the paper's network."""
    makers: dict[tuple[str, str], Callable[[list[torch.nn.Parameter]], torch.optim.Optimizer]] = {
        ("Adam(foreach)", "torch"): partial(torch.optim.Adam, foreach=True)
    }
    makers |= {("AdaTerm", name): AdaTerm for name in variants(args.kernels)}
    out: Contenders = {}
    for name, make in makers.items():
        torch.manual_seed(0)
        params = [torch.nn.Parameter(torch.randn(s)) for s in SHAPES]
        for p in params:
            p.grad = torch.randn_like(p)
        optimizer = make(params)
        out[name] = (lambda optimizer=optimizer: [optimizer.step() for _ in range(20 * args.steps)], 20 * args.steps)
    return out


def target_group(args: argparse.Namespace) -> Contenders:
    """The target updates: CAT-soft against TorchRL's SoftUpdate."""
    from torchrl.objectives import SoftUpdate

    out: Contenders = {}
    for what, name in [("SoftUpdate", "torch"), *(("CATSoftUpdate", name) for name in variants(args.kernels))]:
        loss = TsallisBCLoss([make_policy(OBSERVATION, ACTION) for _ in range(args.members)])
        updater = SoftUpdate(loss, tau=0.1) if what == "SoftUpdate" else CATSoftUpdate(loss)
        with torch.no_grad():  # a distance to go
            for p in loss.parameters():
                p.add_(0.001 * torch.randn_like(p))
        out[what, name] = (lambda updater=updater: [updater.step() for _ in range(args.steps)], args.steps)
    return out


def floor_group(args: argparse.Namespace) -> Contenders:
    """A member-step's matrix products alone, at the rate of torch's batched product and of one large product."""
    torch.manual_seed(0)
    weights = OBSERVATION * args.width + args.width**2 + args.width * 2 * ACTION
    # Forward, backward (twice that, but for the observations' gradient), and the target's forward.
    flop = {"proposal": 2 * args.batch * (4 * weights - OBSERVATION * args.width)}
    flop["bc, peak"] = 2 * args.batch * (3 * weights - OBSERVATION * args.width)
    x, w = torch.randn(args.members, args.batch, args.width), torch.randn(args.members, args.width, args.width)
    large = torch.randn(512, 512)
    products = {
        "batched": (lambda: torch.bmm(x, w), 2 * w.numel() * args.batch),
        "512 x 512": (lambda: large @ large, 2 * 512**3),
    }
    out: Contenders = {}
    for method, needed in flop.items():
        for name, (product, done) in products.items():
            calls = max(1, args.steps * needed * args.members // done)
            run = lambda product=product, calls=calls: [product() for _ in range(calls)]  # noqa: E731
            out[f"products of {method}, {name}", "torch"] = (run, calls * done / needed)
    return out


GROUPS = {
    "stacked": stacked_group,
    "floor": floor_group,
    "single": single_group,
    "recurrent": recurrent_group,
    "optimizer": optimizer_group,
    "target": target_group,
}


def measured(contenders: Contenders, repeats: int, clock: Callable[[], float]) -> dict[tuple[str, str], list[float]]:
    """Seconds a step of each contender in each repeat; the first repeat warms up."""
    seconds: dict[tuple[str, str], list[float]] = {name: [] for name in contenders}
    for repeat in range(repeats + 1):
        for name, (run, steps) in contenders.items():
            with kernels(name[1]):
                start = clock()
                run()
                spent = (clock() - start) / steps
            if repeat:
                seconds[name].append(spent)
    return seconds


def rows_of(group: str, args: argparse.Namespace, machine: dict[str, str]) -> list[dict[str, Any]]:
    """The measurements of a group, as rows of the file."""
    clock = time.process_time if args.threads == 1 else time.perf_counter
    torch.set_num_threads(args.threads)
    load = f"{os.getloadavg()[0]:.2f}"
    seconds = measured(GROUPS[group](args), args.repeats, clock)
    first = next(iter(seconds))
    rows = []
    for (what, name), values in seconds.items():
        # Of each repeat by itself: what disturbs a repeat disturbs all of its contenders.
        ratios = sorted(ratio(value, base) for value, base in zip(values, seconds[first], strict=True))
        low, _, high = statistics.quantiles(ratios, n=4) if len(ratios) > 1 else (ratios[0],) * 3
        row = {"group": group, "what": what, "kernels": name, "clock": "cpu" if args.threads == 1 else "wall"}
        row |= {name: getattr(args, name) for name in ("members", "batch", "width", "threads", "rows", "repeats")}
        row |= {"milliseconds": f"{1e3 * statistics.median(values):.4f}", "first": first[0], "load": load, **machine}
        rows.append(row | {"ratio": f"{statistics.median(ratios):.4f}", "low": f"{low:.4f}", "high": f"{high:.4f}"})
        times = float(rows[-1]["ratio"])
        print(
            f"  {what:38}{name:8}{rows[-1]['milliseconds']:>9} ms   {times:6.3f} of {first[0]} "
            f"({low:.3f} to {high:.3f}), {1 / times:5.2f} times as fast",
            flush=True,
        )
    return rows


def write(rows: list[dict[str, Any]], path: Path) -> None:
    """Writes the rows, all at once."""
    with atomic_path(path) as temporary, open(temporary, "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)


def main() -> None:
    """Measures the groups for every combination of the sizes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--groups", nargs="+", choices=GROUPS, default=list(GROUPS))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--kernels", nargs="+", choices=["torch", "native"], default=["torch", "native"])
    for name, default in (("members", 24), ("batch", 256), ("width", 100), ("threads", 1), ("rows", 29_970)):
        parser.add_argument(f"--{name}", type=int, nargs="+", default=[default])
    parser.add_argument("--steps", type=int, default=20, help="of a measurement")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--out", type=Path, help="CSV file")
    parser.add_argument("--append", action="store_true", help="keep the rows of the file")
    args = parser.parse_args()
    keep_freed_memory()
    warnings.simplefilter("ignore")  # BCLoss warns of its own annotations
    torchrl_logger.setLevel("ERROR")
    machine = {"machine": cpu_name(), "mkl": mkl_kernel(), "torch": torch.__version__}
    print(f"{machine['machine']}, {os.cpu_count()} cores; torch {torch.__version__}")
    print(f"MKL for {machine['mkl']}; torch's own kernels: {torch.backends.cpu.get_cpu_capability()}")
    print(f"native kernels: {native().info() if native() else 'none'}; load {os.getloadavg()}")
    rows: list[dict[str, Any]] = []
    before = list(csv.DictReader(args.out.read_text().splitlines())) if args.append and args.out.exists() else []
    sizes = [(m, b, w, t, n) for m in args.members for b in args.batch for w in args.width for t in args.threads
             for n in args.rows]  # fmt: skip
    for members, batch, width, threads, count in sizes:
        sized = argparse.Namespace(
            **vars(args) | {"members": members, "batch": batch, "width": width, "threads": threads, "rows": count}
        )
        for group in args.groups:
            print(f"{group}: {members} members, batch {batch}, width {width}, {threads} threads, {count} rows")
            rows += rows_of(group, sized, machine)
            if args.out:
                write([*before, *rows], args.out)
    print(f"load at the end {os.getloadavg()}")


if __name__ == "__main__":
    main()
