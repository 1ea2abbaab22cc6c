"""Makes a small file of demonstrations with known faults, to try ``tsallis`` on: an arm's tip is steered to a goal.

60 episodes as D4RL-style npz: ``observations`` are the places of tip and goal in metres, ``actions`` velocities in m/s.
Episodes 10, 25 and 40 go astray for a while, 15 and 50 have a few wild commands, and 30 stops half-way::

    python recipes/example_data.py reach.npz
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from torchrl_tsallis.jobs import atomic_path

EPISODES, STEPS, SECONDS = 60, 80, 0.05
ASTRAY, WILD, STOPPED = (10, 25, 40), (15, 50), (30,)


def episode(number: int) -> dict[str, np.ndarray]:
    """One demonstration."""
    rng = np.random.default_rng([7, number])
    tip, goal = rng.uniform(-0.3, 0.3, 2), rng.uniform(-0.3, 0.3, 2)
    rows = []
    for step in range(STEPS):
        way = goal - tip
        action = 2.0 * way + rng.normal(0.0, 0.02, 2)
        if number in ASTRAY and 10 <= step < 35:
            action = np.array([-way[1], way[0]]) * 2.0 + rng.normal(0.0, 0.02, 2)
        if number in WILD and rng.random() < 0.08:
            action = rng.uniform(-1.0, 1.0, 2)
        if number in STOPPED and step >= 15:
            action = rng.normal(0.0, 0.02, 2)
        rows.append((np.concatenate([tip, goal]), action, -np.linalg.norm(way)))
        tip = tip + SECONDS * action
    ends = np.arange(STEPS) == STEPS - 1
    columns = [np.array(column, dtype=np.float32) for column in zip(*rows, strict=True)]
    return dict(zip(("observations", "actions", "rewards"), columns, strict=True)) | {"timeouts": ends}


def main(path: str) -> None:
    """Writes the file."""
    episodes = [episode(number) for number in range(EPISODES)]
    data = {name: np.concatenate([one[name] for one in episodes]) for name in episodes[0]}
    data["terminals"] = np.zeros(len(data["timeouts"]), dtype=bool)
    with atomic_path(Path(path)) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **data)
    print(f"{path}: {EPISODES} episodes, {len(data['actions'])} steps; astray {ASTRAY}, wild {WILD}, stopped {STOPPED}")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "reach.npz")
