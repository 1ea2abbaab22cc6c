"""The schema: what is accepted, and what is refused by key, shape and row."""

from __future__ import annotations

import logging
import math

import pytest
import torch
from tensordict import TensorDict

from torchrl_tsallis import AdaTerm, CATSoftUpdate, TsallisBCLoss
from torchrl_tsallis.data import (
    make_replay_buffer,
    make_sequence_buffer,
    make_stacked_replay_buffer,
    storage,
    validate_demonstrations,
)
from torchrl_tsallis.modules import make_policy
from torchrl_tsallis.trainers import make_offline_trainer


def rows(n: int = 8, **other) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    entries = {"observation": torch.randn(n, 3, generator=generator), "action": torch.rand(n, 2, generator=generator)}
    return TensorDict({**entries, **other}, [n])


def buffers(data):
    yield make_replay_buffer(data, batch_size=4)
    yield make_stacked_replay_buffer(data, batch_size=4, seeds=[0, 1])


@pytest.mark.parametrize(
    "entries",
    [
        {"action": torch.arange(8)},
        {"action": torch.arange(8).to(torch.int32)},
        {"observation": torch.arange(8)},
        {"observation": {"pixels": torch.zeros(8, 3, 4, 4, dtype=torch.uint8), "state": torch.randn(8, 3)}},
        {"observation": torch.randint(0, 255, (8, 3, 4, 4), dtype=torch.uint8)},
        {"observation": torch.randn(8, 3).bfloat16(), "action": torch.rand(8, 2).bfloat16()},
        {"action": torch.rand(8, 5, 2)},
        {"action": torch.rand(8, 2) > 0.5},
    ],
)
def test_what_the_loss_can_train_on_is_accepted(entries):
    data = rows().update(entries)
    validate_demonstrations(data)
    for buffer in buffers(data):
        batch = buffer.sample()
        for key, value in data.items(True, True):
            assert batch[key].shape == (*batch.shape, *value.shape[1:]) and batch[key].dtype == value.dtype


def test_nested_observations_are_checked_leaf_by_leaf():
    data = rows().set("observation", TensorDict({"state": torch.zeros(8, 3), "pixels": torch.zeros(8, 2)}, [8]))
    data["observation", "state"][[1, 6], 0] = math.nan
    for call in (validate_demonstrations, lambda x: make_replay_buffer(x, batch_size=2)):
        with pytest.raises(ValueError, match=r"'observation', 'state'.* 2 of 8 rows, first \[1, 6\]"):
            call(data)


@pytest.mark.parametrize(
    ("data", "error", "message"),
    [
        ({"observation": torch.zeros(4, 2)}, TypeError, "TensorDict of N rows, got dict"),
        (TensorDict({"observation": torch.zeros(4, 2)}), ValueError, r"batch size \[\].*TensorDict\(..., \[N\]\)"),
        (TensorDict({"observation": torch.zeros(4, 5, 2)}, [4, 5]), ValueError, r"\[4, 5\].*reshape\(-1\)"),
        (rows().rename_key_("observation", "observation.state"), ValueError, r"'observation.state' has a dot.*nest it"),
        (rows(action=torch.zeros(8, 0)), ValueError, r"'action' has shape \[8, 0\]"),
        (rows(action=torch.zeros(8, 2, dtype=torch.complex64)), TypeError, "'action' is torch.complex64"),
        (rows(action=TensorDict({}, [8])), KeyError, "'action'.*is empty"),
        (TensorDict({"observation": ["a"] * 4, "action": torch.zeros(4, 1)}, [4]), TypeError, "'observation' is"),
    ],
)
def test_what_is_no_demonstration_is_refused_by_everything(data, error, message):
    calls = [
        validate_demonstrations,
        lambda x: make_replay_buffer(x, batch_size=2),
        lambda x: make_stacked_replay_buffer([x], seeds=[0], batch_size=2),
        lambda x: make_sequence_buffer(x, slice_len=2, num_slices=1),
    ]
    for call in calls:
        with pytest.raises(error, match=message):
            call(data)


def test_a_continuous_action_needs_a_dimension():
    with pytest.raises(ValueError, match=r"'action' has shape \[8\].*unsqueeze"):
        validate_demonstrations(rows(action=torch.rand(8)))


def test_actions_outside_of_their_space_are_found_in_every_shape():
    for action in (torch.full((8, 2, 2), 2.0), torch.arange(8), TensorDict({"arm": torch.full((8, 1), 2.0)}, [8])):
        with pytest.warns() if not isinstance(action, torch.Tensor) else pytest.raises(ValueError, match="outside"):
            if isinstance(action, torch.Tensor):
                validate_demonstrations(rows(action=action), action_limit=1.0)
            else:
                with pytest.raises(ValueError, match="'arm'.* outside"):
                    validate_demonstrations(rows(action=action), action_limit=1.0)


def test_float64_is_said_and_converted_where_it_is_asked_for(caplog):
    data = rows().apply(lambda x: x.double())
    with caplog.at_level(logging.WARNING):
        validate_demonstrations(data)
    assert "'observation' and 'action' are float64" in caplog.text
    assert make_replay_buffer(data, batch_size=4).sample()["action"].dtype == torch.float64
    for build in (make_replay_buffer, lambda x, **k: make_stacked_replay_buffer(x, seeds=[0], **k)):
        batch = build(data, batch_size=4, dtype=torch.float32).sample()
        assert batch["observation"].dtype == batch["action"].dtype == torch.float32
    mixed = rows(flag=torch.ones(8, dtype=torch.bool)).set("action", torch.rand(8, 2).double())
    batch = make_replay_buffer(mixed, batch_size=4, dtype=torch.float32, keys=["action", "flag"]).sample()
    assert (batch["action"].dtype, batch["flag"].dtype) == (torch.float32, torch.bool)
    with pytest.raises(ValueError, match="dtype=torch.int64"):
        make_replay_buffer(data, batch_size=4, dtype=torch.int64)


@pytest.mark.parametrize("size", [0, -1, 2.5, True, None])
def test_sizes_that_are_none(size):
    with pytest.raises(ValueError, match=f"batch_size={size}"):
        make_replay_buffer(rows(), batch_size=size)
    with pytest.raises(ValueError, match=f"batch_size={size}"):
        make_stacked_replay_buffer(rows(), batch_size=size, seeds=[0])
    with pytest.raises(ValueError, match=f"slice_len={size}"):
        make_sequence_buffer(rows(), slice_len=size, num_slices=1)


@pytest.mark.parametrize("double", [False, True])
def test_a_trainer_gives_its_loss_the_dtype_of_its_weights(double, caplog):
    storage._notice.cache_clear()
    torch.manual_seed(0)
    data = rows(32).apply(lambda x: x.double())
    loss = TsallisBCLoss(make_policy(3, 2, hidden=(8,)))
    loss = loss.double() if double else loss
    buffer = make_replay_buffer(data, batch_size=8)
    make_offline_trainer(
        loss, buffer, AdaTerm(loss.parameters()), updater=CATSoftUpdate(loss), steps=2, log_every=1, progress=False
    ).train()
    assert all(p.isfinite().all() for p in loss.parameters())
    assert ("the loss is float32: batches are converted" in caplog.text) != double
    assert buffer.sample()["action"].dtype == torch.float64
