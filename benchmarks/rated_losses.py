"""Losses without a density, plain and rated, on a regression of which some targets are gross outliers.

A smooth nonlinear function of three numbers, with normal noise of 0.1, of which a share of the samples is replaced by
uniform noise in [-3, 3]; the function itself is in [-1, 1]. For each of TorchRL's BCLoss (squared error),
DiffusionBCLoss and ACTLoss: the root mean square error of the deterministic policy against the noiseless function on
new inputs, and how well ratings tell the outliers (AUROC). The method ``plain`` is the wrapped loss, ``rated`` the same
in RatedLoss with its tuner, ``rated_4`` with four more passes to rate by. Of plain training, the AUROC is that of the
samples' losses. The raw numbers go to a CSV file, one row a training, and the table beside it::

    python benchmarks/rated_losses.py --out docs/results/rated_losses.csv
    python benchmarks/rated_losses.py --out docs/results/rated_losses.csv --table  # of what is there
"""

from __future__ import annotations

import argparse
import csv
import time
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import DiffusionActor
from torchrl.modules.models import ACTModel
from torchrl.objectives import ACTLoss, BCLoss, DiffusionBCLoss
from torchrl.objectives.common import LossModule

from torchrl_tsallis import PeakRating, RatedLoss, ScoreTuner
from torchrl_tsallis.evaluation import auroc, bootstrap_interval

OBSERVATION, ACTION, CHUNK, HIDDEN = 3, 4, 4, 64
ROWS, BATCH, NOISE = 2048, 256, 0.1
TUNER_LR = 0.02  # its default of 0.003 is for trainings of many thousand steps
CHUNK_KEY = ("vla_action", "chunk")


class Task:
    """Inputs, targets and which of them are outliers, from a seed; chunks are the function at shifted phases."""

    def __init__(self, seed: int, outliers: float) -> None:
        generator = torch.Generator().manual_seed(seed)
        self.first = torch.randn(OBSERVATION, 8, generator=generator) / OBSERVATION**0.5
        self.second = torch.randn(8, ACTION, generator=generator) / 8**0.5
        self.data, self.clean = self.draw(ROWS, generator)
        self.bad = torch.rand(ROWS, generator=generator) < outliers
        for key in ("action", CHUNK_KEY):
            noisy = self.data[key] + NOISE * torch.randn(self.data[key].shape, generator=generator)
            noise = 6 * torch.rand(noisy.shape, generator=generator) - 3
            mask = self.bad.view(-1, *[1] * (noisy.ndim - 1))
            self.data[key] = torch.where(mask, noise, noisy)
        self.test, self.target = self.draw(ROWS, generator)

    def draw(self, rows: int, generator: torch.Generator) -> tuple[TensorDict, TensorDict]:
        """Inputs with the noiseless function at them."""
        observation = torch.randn(rows, OBSERVATION, generator=generator)
        inner = (observation @ self.first).tanh() @ self.second
        data = TensorDict({"observation": observation, "action": (2 * inner).sin()}, [rows])
        data[CHUNK_KEY] = (2 * inner[:, None] + 0.3 * torch.arange(CHUNK)[:, None]).sin()
        return data, data.clone()


def mlp(inputs: int, outputs: int) -> nn.Sequential:
    """Two hidden layers."""
    return nn.Sequential(
        nn.Linear(inputs, HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, outputs)
    )


def bc() -> LossModule:
    """Squared error of a regression."""
    actor = TensorDictModule(mlp(OBSERVATION, ACTION), in_keys=["observation"], out_keys=["action"])
    return BCLoss(actor, loss_function="l2", reduction="none")


def diffusion() -> LossModule:
    """Denoising; twenty steps, after which hardly anything is left of the action."""
    net = mlp(ACTION + OBSERVATION + 1, ACTION)
    return DiffusionBCLoss(
        DiffusionActor(ACTION, score_network=net, num_steps=20, beta_start=0.01, beta_end=0.4), reduction="none"
    )


def act() -> LossModule:
    """Chunks of four actions by a small transformer with a latent variable."""
    layers = {"num_encoder_layers": 1, "num_decoder_layers": 1, "latent_dim": 4, "dropout": 0.0}
    model = ACTModel(OBSERVATION, ACTION, CHUNK, hidden_dim=32, nheads=2, dim_feedforward=64, **layers)
    keys = {"in_keys": ["observation", "action_chunk"], "out_keys": ["action_pred", "mu", "log_var"]}
    return ACTLoss(TensorDictModule(model, **keys), kl_weight=10.0, reduction="none")


#: Loss, key of what is minimised, steps, step size, draws of a rating, methods.
LOSSES = {
    "bc": (bc, "loss_bc", 800, 3e-3, 0, ("plain", "rated")),
    "diffusion": (diffusion, "loss_diffusion_bc", 1000, 3e-3, 32, ("plain", "rated", "rated_4")),
    "act": (act, "loss_act", 400, 2e-3, 4, ("plain", "rated")),
}


@torch.no_grad()
def test_error(loss: RatedLoss, name: str, task: Task) -> float:
    """Root mean square error of the deterministic policy against the noiseless function."""
    actor, observation = loss.loss_module.actor_network.eval(), task.test["observation"]
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        if name == "act":
            found, wanted = actor.module(observation)[0], task.target[CHUNK_KEY]
        else:
            found, wanted = (
                actor(TensorDict({"observation": observation}, [len(observation)]))["action"],
                task.target["action"],
            )
    return (found - wanted).square().mean().sqrt().item()


def train(name: str, method: str, outliers: float, seed: int) -> dict[str, float | str | int]:
    """Trains one policy; plain is the rated loss with u = 0, which has the wrapped loss's gradient."""
    make, key, steps, lr, draws, _ = LOSSES[name]
    task = Task(seed, outliers)
    torch.manual_seed(seed)
    rated = method != "plain"
    passes = int(method.removeprefix("rated_")) if "_" in method else 0
    loss = RatedLoss(make(), loss_key=key, rating=PeakRating(u=0.2 if rated else 0.0), draws=passes)
    optimizer, tuner = torch.optim.Adam(loss.parameters(), lr=lr), ScoreTuner(loss, lr=TUNER_LR) if rated else None
    start = time.process_time()
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = lr * (1 - step / steps)
        loss(task.data[torch.randint(ROWS, (BATCH,))])[key].backward()
        optimizer.step()
        optimizer.zero_grad()
        if tuner is not None:
            tuner.step()
    seconds = time.process_time() - start
    u = loss.rating_module.u.item()
    error = test_error(loss, name, task)
    rating = loss.rating(task.data, draws=draws)
    if not rated or u < 0.01:  # any u orders the samples alike; a small one leaves few of them at exactly 0
        loss.rating_module.u.fill_(0.01)
    order = -loss.rating(task.data, draws=draws).numpy()
    bad = task.bad.numpy()
    return {
        "loss": name,
        "method": method,
        "outliers": outliers,
        "seed": seed,
        "rmse": error,
        "auroc": auroc(order[bad], order[~bad]) if bad.any() else float("nan"),
        "u": u,
        "rating_clean": rating[~task.bad].mean().item(),
        "rating_outliers": rating[task.bad].mean().item() if bad.any() else float("nan"),
        "seconds": round(seconds, 2),
    }


def interval(values: list[float], digits: int) -> str:
    """Mean over the seeds with its 95 % bootstrap interval."""
    if np.isnan(values).any():
        return "-"
    found = bootstrap_interval(values, lambda x: float(np.mean(x)))
    return f"{found['value']:.{digits}f} [{found['low']:.{digits}f}, {found['high']:.{digits}f}]"


def cell_of(row: dict[str, str]) -> tuple[str, str, str]:
    """Loss, share of outliers and method."""
    return row["loss"], row["outliers"], row["method"]


def table(rows: list[dict[str, str]]) -> str:
    """Rows of trainings as a Markdown table, one line a loss, share of outliers and method."""
    lines = [
        "| loss | outliers | method | test RMSE | relative to plain | AUROC | u | rating, clean | rating, outliers |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    cells = dict.fromkeys(map(cell_of, rows))
    for cell in cells:
        own = [row for row in rows if cell_of(row) == cell]
        plain = {row["seed"]: float(row["rmse"]) for row in rows if cell_of(row) == (*cell[:2], "plain")}
        values = [interval([float(row["rmse"]) for row in own], 3)]
        values.append(interval([float(row["rmse"]) / plain.get(row["seed"], float("nan")) for row in own], 2))
        for name, digits in (("auroc", 3), ("u", 3), ("rating_clean", 2), ("rating_outliers", 2)):
            values.append(interval([float(row[name]) for row in own], digits))
        lines.append(f"| {cell[0]} | {float(cell[1]):.0%} | `{cell[2]}` | {' | '.join(values)} |")
    return "\n".join(lines)


def main() -> None:
    """Trains what the arguments say and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="CSV file, one row a training")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--outliers", type=float, nargs="+", default=[0.0, 0.1, 0.3])
    parser.add_argument("--losses", nargs="+", default=list(LOSSES), choices=list(LOSSES))
    parser.add_argument("--table", action="store_true", help="only print the table of the file")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if not args.table:
        grid = [
            (loss, method, share, seed)
            for loss in args.losses
            for share in args.outliers
            for method in LOSSES[loss][-1]
            for seed in range(args.seeds)
        ]
        done = [train(*cell) for cell in grid]
        args.out.parent.mkdir(parents=True, exist_ok=True)
        with args.out.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(done[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(done)
    with args.out.open(newline="") as file:
        text = table(list(csv.DictReader(file)))
    args.out.with_suffix(".md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
