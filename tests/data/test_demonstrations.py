"""Recording, storage and checks of demonstrations."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from tensordict import TensorDict

from torchrl_tsallis.data.demonstrations import (
    load_demonstrations,
    record_trajectory,
    save_demonstrations,
    validate_demonstrations,
)
from torchrl_tsallis.data.policy import NumpyPolicy, load_policy


def policy() -> NumpyPolicy:
    rng = np.random.default_rng(0)
    sizes = {"w1": (3, 4), "b1": (4,), "w2": (4, 4), "b2": (4,), "w3": (4, 4), "b3": (4,)}
    return NumpyPolicy({name: rng.standard_normal(size) for name, size in sizes.items()})


class Counter:
    """Observes its step count; the episode of the first seed ends at once."""

    def __init__(self, lengths: list[int]) -> None:
        self.lengths = lengths
        self.resets = -1

    def reset(self, seed=None):
        self.resets += 1
        self.steps = 0
        return np.full(3, 0.0), {}

    def step(self, action):
        self.steps += 1
        return np.full(3, float(self.steps)), 2.0, self.steps >= self.lengths[self.resets], False, {}

    def close(self):
        pass


def rows(n: int = 6) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    return TensorDict({"observation": torch.randn(n, 3, generator=generator), "action": torch.rand(n, 2)}, [n])


def test_the_policy_by_hand():
    p = policy()
    x = np.array([1.0, -2.0, 0.5], dtype=np.float32)
    t = p.tensors
    hidden = np.maximum(np.maximum(x @ t["w1"] + t["b1"], 0) @ t["w2"] + t["b2"], 0)
    np.testing.assert_allclose(p(x), np.tanh((hidden @ t["w3"] + t["b3"])[:2]), rtol=1e-6)
    noise = [5.0 * np.random.default_rng(i).standard_normal(2) for i in range(50)]
    noisy = np.stack([p.act(x, np.random.default_rng(i), 5.0) for i in range(50)])
    np.testing.assert_allclose(noisy, p(x) + noise, rtol=1e-5)  # commands are recorded as they were sampled
    clipped = np.stack([p.act(x, np.random.default_rng(i), 5.0, clip=True) for i in range(50)])
    np.testing.assert_array_equal(clipped, np.clip(noisy, -1, 1))
    assert np.abs(noisy).max() > 1
    assert p.act(x, np.random.default_rng(0), 0.0) == pytest.approx(p(x))


def test_recording_discards_episodes_that_end_early():
    data, discarded = record_trajectory(lambda: Counter([9, 2, 9]), policy(), std=0.1, seed=0, length=4)
    assert discarded == 1
    assert data["observation"][:, 0].tolist() == [0, 1, 2, 3]
    assert data["info", "ep_return"].tolist() == [8.0] * 4
    again, _ = record_trajectory(lambda: Counter([9, 2, 9]), policy(), std=0.1, seed=0, length=4)
    assert torch.equal(again["action"], data["action"])
    with pytest.raises(RuntimeError, match="2 episodes from seed 0"):
        record_trajectory(lambda: Counter([9, 2, 2]), policy(), std=0.1, seed=0, length=4, tries=2)


def test_storage_round_trip_and_truncation(tmp_path):
    data = rows().set("info", TensorDict({"is_noise": torch.ones(6, dtype=torch.bool)}, [6]))
    file = tmp_path / "data.safetensors"
    save_demonstrations(file, data, {"std": 0.2})
    loaded, metadata = load_demonstrations(file)
    assert metadata == {"std": 0.2}
    assert (loaded == data).all()
    file.write_bytes(file.read_bytes()[:-20])
    with pytest.raises(ValueError, match="truncated.*record again"):
        load_demonstrations(file)
    with pytest.raises(ValueError, match="truncated.*copy it again"):
        load_policy(file)


def test_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="cannot write .*permissions"):
        save_demonstrations(tmp_path / "file" / "data.safetensors", rows(), {})


def test_validation_names_key_rows_and_fix():
    validate_demonstrations(rows(), action_limit=1.0)
    bad = rows()
    bad["observation"][3, 1] = math.inf
    with pytest.raises(ValueError, match=r"'observation' is NaN or infinite in 1 of 6 rows, first \[3\]"):
        validate_demonstrations(bad)
    with pytest.raises(KeyError, match="no .*action"):
        validate_demonstrations(rows().exclude("action"))
    with pytest.raises(TypeError, match="mixed dtypes"):
        validate_demonstrations(rows().set("action", torch.rand(6, 2).double()))
    with pytest.raises(ValueError, match=r"shape \[6\]"):
        validate_demonstrations(rows().set("action", torch.rand(6)))
    for n in (0, 1):
        with pytest.raises(ValueError, match=f"{n} samples"):
            validate_demonstrations(rows(n))
    outside = rows()
    outside["action"][2] = 3.0
    with pytest.raises(ValueError, match=r"outside of \[-1.0, 1.0\] in 1 of 6 rows, first \[2\]"):
        validate_demonstrations(outside, action_limit=1.0)
    constant = rows()
    constant["observation"][:, 1] = 4.0
    with pytest.warns(UserWarning, match=r"never changes in dimensions \[1\]"):
        validate_demonstrations(constant)


def test_a_policy_that_does_not_fit():
    tensors = dict(policy().tensors)
    with pytest.raises(ValueError, match="w2 of shape"):
        NumpyPolicy(tensors | {"w2": np.zeros((5, 4))})
    tensors.pop("b3")
    with pytest.raises(ValueError, match="'b3' is missing"):
        NumpyPolicy(tensors)


@pytest.mark.parametrize(
    ("tensors", "metadata", "message"),
    [
        ({"action": torch.zeros(3, 1)}, {"recording": "{"}, "metadata of '.*data.safetensors' is no JSON"),
        ({"action": torch.zeros(3, 1)}, {"recording": "[1]"}, "metadata of '.*data.safetensors' is list"),
        ({}, {"recording": "{}"}, "'.*data.safetensors' holds no tensor"),
        ({"action": torch.zeros(3, 1), "std": torch.tensor(0.2)}, {}, "'std' of '.*data.safetensors' is a scalar"),
        (
            {"action": torch.zeros(3, 1), "observation": torch.zeros(4, 1)},
            {},
            "'.*data.safetensors' have unequal lengths, {'action': 3, 'observation': 4}",
        ),
        ({"a": torch.zeros(3), "a.b": torch.zeros(3)}, {}, r"\['a', 'a.b'\] of '.*data.safetensors' nest"),
    ],
)
def test_files_that_hold_no_rows_are_named(tmp_path, tensors, metadata, message):
    save_file(tensors, tmp_path / "data.safetensors", metadata)
    with pytest.raises(ValueError, match=message):
        load_demonstrations(tmp_path / "data.safetensors")


def test_files_that_are_not_there_or_not_files(tmp_path):
    with pytest.raises(FileNotFoundError, match="'.*none.safetensors' is not there"):
        load_demonstrations(tmp_path / "none.safetensors")
    with pytest.raises(OSError, match=f"{tmp_path}"):
        load_demonstrations(tmp_path)
    (tmp_path / "empty.safetensors").write_bytes(b"")
    with pytest.raises(ValueError, match="'.*empty.safetensors' is truncated"):
        load_demonstrations(tmp_path / "empty.safetensors")


def test_what_cannot_be_saved(tmp_path):
    with pytest.raises(TypeError, match="data.safetensors' is not JSON-able"):
        save_demonstrations(tmp_path / "data.safetensors", rows(), {"std": np.float32(1)})
    with pytest.raises(ValueError, match="'observation.state' has a dot"):
        data = rows().rename_key_("observation", "observation.state")
        save_demonstrations(tmp_path / "data.safetensors", data, {})
    assert not list(tmp_path.iterdir())
