"""When `tsallis rate` gives a verdict, on simulated demonstrations of which it is known which episodes are corrupted.

    python benchmarks/verdict_limits.py > docs/results/verdict_limits.txt

Smooth observations, actions that follow from them, and in some episodes random actions instead; 16 ratings, about four
minutes on one core. One line a set of data: whether the rating says that it is usable, on what that rests, and whether
the corrupted episodes have the greater surprise (AUROC, 1 where all of them do).
"""

from __future__ import annotations

import tempfile

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_tsallis.run import rate

# kind of the actions, episodes, steps, dimensions of observation and action, corrupted episodes
SETS = (
    ("normal", 30, 60, 6, 3, 0),
    ("normal", 30, 60, 6, 3, 3),
    ("normal", 30, 60, 6, 3, 12),
    ("random", 30, 60, 6, 3, 0),
    ("heavy tails", 30, 60, 6, 3, 3),
    ("exact", 30, 60, 6, 3, 3),
    ("normal", 10, 40, 40, 20, 2),
    ("normal", 10, 60, 3, 2, 2),
)


def demonstrations(kind: str, episodes: int, steps: int, obs: int, act: int, corrupted: int, seed: int) -> TensorDict:
    """Episodes of which the first are corrupted."""
    rng = np.random.default_rng(seed)
    weight = rng.normal(size=(obs, act)) / np.sqrt(obs)
    time = np.arange(steps)[:, None] / steps
    observations, actions = [], []
    for k in range(episodes):
        phase, size = rng.uniform(0, 6.28, (4, obs)), rng.normal(size=(4, obs)) / np.arange(1, 5)[:, None]
        x = sum(size[j] * np.sin(6.28 * (j + 1) * time + phase[j]) for j in range(4))
        u = np.tanh(x @ weight)
        if kind == "random":
            u = rng.normal(size=(steps, act))
        elif kind == "heavy tails":
            u = u + 0.05 * rng.standard_t(2, size=(steps, act))
        elif kind == "normal":
            u = u + 0.05 * rng.normal(size=(steps, act))
        if k < corrupted:
            u = rng.normal(size=(steps, act)) * 0.5
        observations.append(x)
        actions.append(u)
    rows = {"observation": np.concatenate(observations), "action": np.concatenate(actions)}
    data = {key: torch.tensor(value).float() for key, value in rows.items()}
    return TensorDict({**data, "episode": torch.arange(episodes).repeat_interleave(steps)}, [episodes * steps])


def main() -> None:
    """Rates all sets with two seeds each."""
    print("actions      episodes steps   O   A corrupted seed usable   rho reliability decade stretch auroc")
    for kind, episodes, steps, obs, act, corrupted in SETS:
        for seed in (0, 1):
            data = demonstrations(kind, episodes, steps, obs, act, corrupted, seed)
            with tempfile.TemporaryDirectory() as folder:
                run = rate(data, f"{folder}/run", progress=False)
                surprise = np.array([float(row["surprise"]) for row in run.episodes])
                said = run.summary
            bad, good = surprise[:corrupted], surprise[corrupted:]
            auroc = f"{(bad[:, None] > good).mean():.2f}" if corrupted else "-"
            agree, stretch = said["agreement"], np.median(said["stretch"])
            print(
                f"{kind:12} {episodes:8} {steps:5} {obs:3} {act:3} {corrupted:9} {seed:4} {said['usable']!s:>6} "
                f"{agree['spearman']:5.2f} {agree['reliability']:11.2f} {said['calibration']['1']:6.2f} {stretch:7.2f} "
                f"{auroc:>5}",
                flush=True,
            )


if __name__ == "__main__":
    main()
