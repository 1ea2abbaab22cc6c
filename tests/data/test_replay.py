"""Buffers of demonstrations: order, resume and bad data."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from torchrl_tsallis.data import make_replay_buffer


def rows(n: int = 10) -> TensorDict:
    info = TensorDict({"is_noise": torch.ones(n, dtype=torch.bool)}, [n])
    return TensorDict({"observation": torch.arange(n).float()[:, None], "action": torch.zeros(n, 2), "info": info}, [n])


def order(buffer, batches: int) -> list[float]:
    return [x for _ in range(batches) for x in buffer.sample()["observation"][:, 0].tolist()]


def test_an_epoch_sees_every_sample_once_and_no_label():
    buffer = make_replay_buffer(rows(), batch_size=5)
    assert "info" not in buffer.sample().keys()  # noqa: SIM118
    buffer = make_replay_buffer(rows(), batch_size=5)
    assert sorted(order(buffer, 2)) == list(range(10))
    assert sorted(order(buffer, 2)) == list(range(10))


def test_the_seed_alone_decides_the_order():
    torch.manual_seed(0)
    first = order(make_replay_buffer(rows(), batch_size=3, seed=1), 7)
    torch.manual_seed(1)
    assert order(make_replay_buffer(rows(), batch_size=3, seed=1), 7) == first
    assert order(make_replay_buffer(rows(), batch_size=3, seed=2), 7) != first


def test_errors_name_the_key_and_the_rows():
    data = rows()
    data["action"][[2, 7], 0] = math.nan
    with pytest.raises(ValueError, match=r"'action'.*2 of 10 rows, first \[2, 7\]"):
        make_replay_buffer(data, batch_size=2)
    with pytest.raises(KeyError, match="no .*action"):
        make_replay_buffer(rows().exclude("action"), batch_size=2)
    with pytest.raises(ValueError, match="fewer than a batch"):
        make_replay_buffer(rows(3))
