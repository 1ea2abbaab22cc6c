"""Demonstrations are rated from a file, and the folder opens again."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_tsallis.run import Run, rate


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    rng = np.random.default_rng(0)
    x = rng.normal(size=(720, 3))
    a = np.tanh(x[:, :2]) + 0.05 * rng.normal(size=(720, 2))
    for k in (3, 8):
        a[60 * k : 60 * k + 60] = rng.normal(size=(60, 2)) * 2
    path = tmp_path_factory.mktemp("data") / "demonstrations.npz"
    np.savez(path, observations=x, actions=a, terminals=np.arange(720) % 60 == 59)
    return path


@pytest.fixture(scope="module")
def run(file, tmp_path_factory):
    return rate(file, tmp_path_factory.mktemp("runs") / "run", steps=300, progress=False)


def test_the_corrupted_episodes_rank_worst(run):
    worst = sorted(run.episodes, key=lambda row: -float(row["surprise"]))[:2]
    assert {row["source"] for row in worst} == {"3", "8"}


def test_an_opened_run_rates_the_same_bit_for_bit(run, file):
    again = Run.open(run.folder)
    assert torch.equal(run.rate(file), again.rate(file))


def test_an_existing_run_is_kept(run, file):
    with pytest.raises(FileExistsError, match="overwrite"):
        rate(file, run.folder, steps=10, progress=False)
