"""Rows and batches on another device; torch's ``meta`` stands for one."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_tsallis.data import (
    make_replay_buffer,
    make_sequence_buffer,
    make_stacked_replay_buffer,
    sequences,
    storage,
)
from torchrl_tsallis.modes import make_episode_buffer


def demonstrations():
    torch.manual_seed(0)
    data = TensorDict({"observation": torch.rand(8, 3), "action": torch.rand(8, 2)}, [8])
    data["is_init"] = (torch.arange(8) % 4 == 0)[:, None]
    data["next"] = TensorDict({"observation": torch.rand(8, 3), "done": data["is_init"].roll(-1, 0)}, [8])
    return data.set("episode", torch.arange(8) // 4)


BUFFERS = {
    "single": lambda **options: make_replay_buffer(demonstrations(), batch_size=4, **options),
    "stacked": lambda **options: make_stacked_replay_buffer(demonstrations(), seeds=[0, 1], batch_size=4, **options),
    "episodes": lambda **options: make_episode_buffer(demonstrations(), seeds=[0, 1], batch_size=4, **options),
    "sequences": lambda **options: make_sequence_buffer(demonstrations(), slice_len=4, num_slices=2, **options),
}


@pytest.mark.parametrize("build", BUFFERS)
def test_batches_come_from_the_device_that_was_asked_for(build, monkeypatch):
    for module in (storage, sequences):
        monkeypatch.setattr(module, "check_device", torch.device)  # meta cannot be read back
    here, there = BUFFERS[build]().sample(), BUFFERS[build](device="meta").sample()
    assert {value.device.type for value in here.values(True, True)} == {"cpu"}
    assert there["action"].device.type == there["observation"].device.type == "meta"
    assert there["action"].shape == here["action"].shape


@pytest.mark.parametrize("build", BUFFERS)
def test_rows_stay_on_disk_where_the_device_is_the_cpu(build):
    assert BUFFERS[build](device="cpu").sample()["action"].equal(BUFFERS[build]().sample()["action"])


@pytest.mark.parametrize("build", BUFFERS)
@pytest.mark.parametrize(
    ("device", "kind", "said"),
    [
        ("meta", ValueError, "device='meta' is not there"),
        ("gpu", ValueError, "device='gpu'"),
        (0, TypeError, "device=0"),
    ],
)
def test_a_device_that_is_not_there_is_named(build, device, kind, said):
    with pytest.raises(kind, match=said):
        BUFFERS[build](device=device)
