"""Small demonstrations of known quality."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

CORRUPTED = ("3", "8")


@pytest.fixture(scope="session")
def rows():
    """12 episodes of 60 steps, of which the fourth and the ninth have random actions."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(720, 3))
    a = np.tanh(x[:, :2]) + 0.05 * rng.normal(size=(720, 2))
    for k in map(int, CORRUPTED):
        a[60 * k : 60 * k + 60] = rng.normal(size=(60, 2)) * 2
    return x.astype(np.float32), a.astype(np.float32)


@pytest.fixture(scope="session")
def write_npz(rows):
    """Writes them, in other units where asked for."""

    def write(path, observation=1.0, action=1.0):
        x, a = rows
        ends = np.arange(len(x)) % 60 == 59
        np.savez(path, observations=x * np.float32(observation), actions=a * np.float32(action), terminals=ends)
        return path

    return write


@pytest.fixture(scope="session")
def file(write_npz, tmp_path_factory):
    """The file."""
    return write_npz(tmp_path_factory.mktemp("data") / "demonstrations.npz")


@pytest.fixture(scope="session")
def data(rows):
    """The same in memory."""
    x, a = map(torch.from_numpy, rows)
    return TensorDict({"observation": x, "action": a, "episode": torch.arange(720) // 60}, [720])
