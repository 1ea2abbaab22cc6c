"""Cost of a recurrent training step: this method and its prediction loss against TorchRL's ``BCLoss``.

The same recurrent actor, batch ``[4, 500]`` and optimizer, one thread, interleaved repeats; prints the ratio of the
medians::

    python benchmarks/bench_recurrent.py
"""

from __future__ import annotations

import statistics
import time
import warnings
from collections.abc import Callable

import torch
from tensordict import TensorDict
from torchrl.objectives import BCLoss

from torchrl_tsallis import CATSoftUpdate, PredictiveBCLoss, QTuner
from torchrl_tsallis.modules import make_recurrent_policy

SLICES, LENGTH, OBSERVATION, ACTION = 4, 500, 12, 3
REPEATS, STEPS = 9, 4


def make_bc() -> Callable[[TensorDict], None]:
    """A step of TorchRL's behavioral cloning."""
    loss = BCLoss(make_recurrent_policy(OBSERVATION, ACTION))
    optimizer = torch.optim.Adam(loss.parameters())

    def step(batch: TensorDict) -> None:
        loss(batch)["loss_bc"].backward()
        optimizer.step()
        optimizer.zero_grad()

    return step


def make_tsallis() -> Callable[[TensorDict], None]:
    """A step of the proposal with the prediction."""
    loss = PredictiveBCLoss(make_recurrent_policy(OBSERVATION, ACTION))
    optimizer = torch.optim.Adam(loss.parameters())
    updater, tuner = CATSoftUpdate(loss), QTuner(loss)

    def step(batch: TensorDict) -> None:
        out = loss(batch)
        (out["loss_tsallis_bc"] + out["loss_prediction"]).backward()
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
    size = (SLICES, LENGTH)
    batch = TensorDict({"observation": torch.randn(*size, OBSERVATION), "action": torch.randn(*size, ACTION)}, size)
    batch["is_init"] = torch.zeros(*size, 1, dtype=torch.bool)
    batch["is_init"][:, 0] = True
    batch["next", "observation"] = torch.randn(*size, OBSERVATION)
    steps = {"BCLoss": make_bc(), "PredictiveBCLoss": make_tsallis()}
    times: dict[str, list[float]] = {name: [] for name in steps}
    for repeat in range(REPEATS + 1):  # the first warms up
        for name, step in steps.items():
            start = time.process_time()
            for _ in range(STEPS):
                step(batch.copy())  # BCLoss writes into it
            if repeat:
                times[name].append((time.process_time() - start) / STEPS)
    medians = {name: statistics.median(values) for name, values in times.items()}
    for name, value in medians.items():
        print(f"{name:16} {1e3 * value:6.2f} ms a step (CPU)")
    print(f"ratio {medians['PredictiveBCLoss'] / medians['BCLoss']:.2f} (at most 1.6 wanted)")


if __name__ == "__main__":
    main()
