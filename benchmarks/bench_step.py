"""Cost of a training step: the loss with its target update and tuner against TorchRL's ``BCLoss``.

Same network, batch and optimizer, one thread, interleaved repeats; prints the ratios of the medians: of the Ant's
policy by the paper's rating and by the peak rating, or of the recurrent one with its prediction of the next
observation::

    python benchmarks/bench_step.py
    python benchmarks/bench_step.py --recurrent
"""

from __future__ import annotations

import argparse
import statistics
import time
import warnings
from collections.abc import Callable

import torch
from tensordict import TensorDict
from torchrl.objectives import BCLoss, LossModule

from torchrl_tsallis import CATSoftUpdate, PeakRating, PredictiveBCLoss, TsallisBCLoss
from torchrl_tsallis.modules import make_policy, make_recurrent_policy

REPEATS = 11
Step = Callable[[TensorDict], None]


def make_step(loss: LossModule, make_optimizer: Callable[..., torch.optim.Optimizer] = torch.optim.Adam) -> Step:
    """A step that minimises the sum of a loss' terms, and updates what the loss has: a target network, a rating."""
    optimizer = make_optimizer(loss.parameters())
    after = [optimizer.step, optimizer.zero_grad]
    if isinstance(loss, TsallisBCLoss):
        after += [CATSoftUpdate(loss).step] if loss.needs_target else []
        after += [loss.rating_module.tuner()(loss).step]

    def step(batch: TensorDict) -> None:
        out = loss(batch)
        sum(value for key, value in out.items() if key.startswith("loss_")).backward()
        for function in after:
            function()

    return step


def ant() -> tuple[dict[str, Step], TensorDict, int, dict[str, float]]:
    """The steps, the batch, steps a measurement, and the ratios that are wanted."""
    size, observation, action = 256, 28, 8
    batch = TensorDict({"observation": torch.randn(size, observation), "action": torch.randn(size, action)}, [size])
    plain = BCLoss(make_policy(observation, action))
    paper = TsallisBCLoss(make_policy(observation, action))
    peak = TsallisBCLoss(make_policy(observation, action), rating=PeakRating())
    steps = {"BCLoss": make_step(plain), "the paper's rating": make_step(paper), "the peak rating": make_step(peak)}
    return steps, batch, 60, {"the paper's rating": 1.5, "the peak rating": 1.05}


def recurrent() -> tuple[dict[str, Step], TensorDict, int, dict[str, float]]:
    """The same of the page-flipping policy, on four trajectories of 500 steps."""
    size, observation, action = (4, 500), 12, 3
    batch = TensorDict({"observation": torch.randn(*size, observation), "action": torch.randn(*size, action)}, size)
    batch["is_init"] = torch.zeros(*size, 1, dtype=torch.bool)
    batch["is_init"][:, 0] = True
    batch["next", "observation"] = torch.randn(*size, observation)
    plain = BCLoss(make_recurrent_policy(observation, action))
    ours = PredictiveBCLoss(make_recurrent_policy(observation, action))
    return {"BCLoss": make_step(plain), "PredictiveBCLoss": make_step(ours)}, batch, 4, {"PredictiveBCLoss": 1.6}


def main() -> None:
    """Measures them in turn."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--recurrent", action="store_true")
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # BCLoss warns of its own annotations
    torch.manual_seed(0)
    steps, batch, count, wanted = recurrent() if parser.parse_args().recurrent else ant()
    times: dict[str, list[float]] = {name: [] for name in steps}
    for repeat in range(REPEATS + 1):  # the first warms up
        for name, step in steps.items():
            start = time.process_time()
            for _ in range(count):
                step(batch.copy())  # BCLoss writes into it
            if repeat:
                times[name].append((time.process_time() - start) / count)
    medians = {name: statistics.median(values) for name, values in times.items()}
    for name, value in medians.items():
        ratio = (
            f"; {value / medians['BCLoss']:.2f} times BCLoss (at most {wanted[name]} wanted)" if name in wanted else ""
        )
        print(f"{name:20}{1e3 * value:6.2f} ms a step (CPU){ratio}")


if __name__ == "__main__":
    main()
