"""Cost of a training step: the method's loss, target update and q tuner against TorchRL's ``BCLoss``.

Same network, batch and optimizer, one thread, interleaved repeats; prints the ratio of the medians::

    python benchmarks/bench_step.py
"""

from __future__ import annotations

import statistics
import time
import warnings
from collections.abc import Callable

import torch
from tensordict import TensorDict
from torchrl.objectives import BCLoss

from torchrl_tsallis import CATSoftUpdate, QTuner, TsallisBCLoss
from torchrl_tsallis.modules import make_policy

BATCH, OBSERVATION, ACTION = 256, 28, 8
REPEATS, STEPS = 15, 60


def make_bc() -> Callable[[TensorDict], None]:
    """A step of TorchRL's behavioral cloning."""
    loss = BCLoss(make_policy(OBSERVATION, ACTION))
    optimizer = torch.optim.Adam(loss.parameters())

    def step(batch: TensorDict) -> None:
        loss(batch)["loss_bc"].backward()
        optimizer.step()
        optimizer.zero_grad()

    return step


def make_tsallis() -> Callable[[TensorDict], None]:
    """A step of the proposal."""
    loss = TsallisBCLoss(make_policy(OBSERVATION, ACTION))
    optimizer = torch.optim.Adam(loss.parameters())
    updater, tuner = CATSoftUpdate(loss), QTuner(loss)

    def step(batch: TensorDict) -> None:
        loss(batch)["loss_tsallis_bc"].backward()
        optimizer.step()
        optimizer.zero_grad()
        updater.step()
        tuner.step()

    return step


def main() -> None:
    """Measures both in turn."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # BCLoss warns of its own annotations
    torch.manual_seed(0)
    batch = TensorDict({"observation": torch.randn(BATCH, OBSERVATION), "action": torch.randn(BATCH, ACTION)}, [BATCH])
    steps = {"BCLoss": make_bc(), "TsallisBCLoss": make_tsallis()}
    times: dict[str, list[float]] = {name: [] for name in steps}
    for repeat in range(REPEATS + 1):  # the first warms up
        for name, step in steps.items():
            start = time.process_time()
            for _ in range(STEPS):
                step(batch)
            if repeat:
                times[name].append((time.process_time() - start) / STEPS)
    medians = {name: statistics.median(values) for name, values in times.items()}
    for name, value in medians.items():
        print(f"{name:14} {1e3 * value:6.2f} ms a step (CPU)")
    print(f"ratio {medians['TsallisBCLoss'] / medians['BCLoss']:.2f} (at most 1.5 wanted)")


if __name__ == "__main__":
    main()
