"""Policies in NumPy take only the network that they compute: what was found, and what was expected."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file
from torch import nn
from torchrl.modules import GRUModule

from torchrl_tsallis.data import NumpyPolicy, Scaling, load_policy
from torchrl_tsallis.evaluation import MeanPolicy, RecurrentMeanPolicy
from torchrl_tsallis.modules import RMSNorm, Squish, make_policy, make_recurrent_policy
from torchrl_tsallis.modules.policy import NormalHead

SCALING = Scaling(torch.zeros(3), torch.ones(3), 1.0).state_dict()


def mean_state(**changes):
    state = make_policy(3, 2, hidden=(4, 4)).state_dict()
    start = "module.0.module."
    for name, value in changes.items():
        key = start + name.replace("_", ".")
        state = {k: v for k, v in state.items() if k != key} | ({} if value is None else {key: value})
    return state


@pytest.mark.parametrize("hidden", [(), (4,), (4, 5), (4, 5, 6, 7)])
def test_any_depth_of_make_policy_is_read_in_any_order(hidden):
    state = make_policy(3, 2, hidden=hidden).state_dict()
    policy = MeanPolicy.from_actor_state(dict(reversed(state.items())))
    assert [len(weight) for weight, _, _ in policy.layers] == [*hidden, 4]


def sequential(*modules):
    return nn.Sequential(*modules).state_dict()


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (sequential(nn.Linear(3, 4), nn.ReLU(), nn.Linear(4, 4)), "found parameters at 0, 2; expected.*RMSNorm 1"),
        (sequential(nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 4), nn.Tanh(), nn.Linear(4, 4)), "found .*0, 2, 4;"),
        (sequential(nn.Linear(3, 4), RMSNorm(4), nn.Linear(4, 4)), "found parameters at 0, 1, 2;"),
        (sequential(nn.Linear(3, 4), RMSNorm(4), nn.PReLU(), nn.Linear(4, 4)), "found parameters at 0, 1, 2, 3;"),
        (sequential(nn.Linear(3, 4), nn.LayerNorm(4), Squish(), nn.Linear(4, 4)), "'1.bias' belongs to no linear"),
        (
            sequential(nn.Linear(3, 4), nn.BatchNorm1d(4), Squish(), nn.Linear(4, 4)),
            "cannot place '1.num_batches",
        ),
        (sequential(nn.Linear(3, 4), RMSNorm(4), Squish(), nn.Linear(4, 4), RMSNorm(4)), "found .*0, 1, 3, 4;"),
        (sequential(RMSNorm(3), nn.Linear(3, 4)), "cannot place '0.weight'"),
        (sequential(nn.Conv1d(3, 4, 1), nn.Linear(4, 4)), "cannot place '0.weight' of shape"),
        (mean_state(**{"9_weight": torch.zeros(4, 4), "9_bias": torch.zeros(4)}), "found parameters at .*module.9;"),
        (mean_state(scale=torch.zeros(4)), "cannot place 'module.0.module.scale'"),
        (mean_state(**{"1_weight": torch.ones(5)}), r"layer 0: weight, bias and norm must be \[out, in\]"),
        (mean_state(**{"3_weight": torch.ones(4, 5)}), r"layer 1: .*must be \[out, 4\]"),
        (mean_state(**{"3_weight": torch.full((4, 4), torch.nan)}), "'module.0.module.3.weight' is not finite"),
        (mean_state(**{"6_weight": torch.ones(3, 4), "6_bias": torch.ones(3)}), "an even number of outputs"),
        (mean_state(**{"0_weight": torch.ones(2, 4, 3)}), "cannot place"),
        (mean_state(**{"0_bias": "text"}), "must be an array of numbers"),
        ({}, "even number of outputs"),
    ],
)
def test_another_network_s_state_is_refused(state, message):
    with pytest.raises(ValueError, match=message):
        MeanPolicy.from_actor_state(state)


def test_a_layer_without_a_bias_is_refused():
    for name in ("0_bias", "3_bias", "6_bias"):
        with pytest.raises(KeyError, match="has no bias"):
            MeanPolicy.from_actor_state(mean_state(**{name: None}))


def recurrent_state(**changes):
    state = {**make_recurrent_policy(3, 2, hidden_size=4).state_dict(), **SCALING}
    for name, value in changes.items():
        keys = [key for key in state if key.endswith(name)] or [name]
        state = {key: v for key, v in state.items() if key != keys[0]} | ({} if value is None else {keys[0]: value})
    return state


@pytest.mark.parametrize("options", [{}, {"num_layers": 1}, {"num_layers": 3}, {"prediction_key": None}])
def test_recurrent_policies_of_make_recurrent_policy_are_read(options):
    policy = RecurrentMeanPolicy.from_state({**make_recurrent_policy(3, 2, **options).state_dict(), **SCALING})
    assert len(policy.layers) == options.get("num_layers", 2) and policy(np.zeros(3)).shape == (2,)


def gru_state():
    gru = GRUModule(input_size=3, hidden_size=4, in_key="observation", out_key="h")
    return {**gru.state_dict(), **nn.ModuleDict({"head": nn.Sequential(nn.Linear(4, 4))}).state_dict(), **SCALING}


def lstm_state(head=None, **options):
    parts = {"lstm": nn.LSTM(3, 4, **options), "head": head or nn.Sequential(nn.Linear(4, 4), NormalHead())}
    return {**nn.ModuleDict(parts).state_dict(), **SCALING}


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (gru_state(), "the 3 gates of a GRU"),
        (lstm_state(bidirectional=True), "cannot place 'lstm.bias_hh_l0_reverse'"),
        (lstm_state(proj_size=2), "cannot place 'lstm.weight_hr_l0'"),
        (lstm_state(nn.Sequential(nn.Linear(4, 4), nn.Linear(4, 4))), "cannot place 'head.1.bias'"),
        (lstm_state(nn.Sequential(nn.Linear(5, 4))), r"the head's weight must have shape \[4, 4\], got \[4, 5\]"),
        (lstm_state(nn.Sequential(nn.Linear(4, 3))), "the head's weight must have shape"),
        (recurrent_state(observation_mean=torch.zeros(5)), "observation_std must have shape"),
        (recurrent_state(observation_std=torch.zeros(3)), "must be positive"),
        (recurrent_state(action_unit=torch.tensor(-1.0)), "must be positive"),
        (recurrent_state(action_unit=torch.ones(2)), "action_unit must be one number"),
        (recurrent_state(weight_hh_l1=torch.full((16, 4), torch.inf)), "weight_hh_l1' is not finite"),
        (recurrent_state(weight_ih_l1=torch.zeros(16, 5)), "w_ih of LSTM layer 1 must have shape"),
        (recurrent_state(bias_hh_l0=torch.zeros(8)), "bias_hh_l0 must have shape"),
        (recurrent_state(extra=torch.zeros(8)), "cannot place 'extra'"),
    ],
)
def test_another_recurrent_network_s_state_is_refused(state, message):
    with pytest.raises(ValueError, match=message):
        RecurrentMeanPolicy.from_state(state)


def test_a_recurrent_state_that_lacks_a_part_names_it():
    for name in ("observation_mean", "observation_std", "action_unit", "bias_hh_l1", "weight_hh_l0", "0.bias"):
        with pytest.raises(KeyError, match=f"{name}' is missing: needed are"):
            RecurrentMeanPolicy.from_state(recurrent_state(**{name: None}))


def tensors(**changes):
    sizes = {"w1": (3, 4), "b1": (4,), "w2": (4, 4), "b2": (4,), "w3": (4, 4), "b3": (4,)}
    return {**{name: np.ones(size, np.float32) for name, size in sizes.items()}, **changes}


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (tensors(w4=np.ones((4, 4))), "'w4' is one more, of another network"),
        (tensors(norm=np.ones(4)), "'norm' is one more"),
        (tensors(w1=np.ones(4)), r"w1 of shape \[4\] must be a matrix"),
        (tensors(b2=np.ones(5)), "w2 of shape"),
        (tensors(w3=np.ones((4, 3)), b3=np.ones(3)), "an even number of outputs, not 3"),
        (tensors(w2=np.full((4, 4), np.nan)), "w2 is not finite"),
        (tensors(b1=["a"]), "b1 must be an array of numbers"),
        (mean_state(), "'w1' is missing, there are module.0.module.0.bias"),
    ],
)
def test_another_shipped_network_is_refused(state, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        NumpyPolicy(state)
    if all(isinstance(value, np.ndarray) for value in state.values()):
        save_file(state, tmp_path / "policy.safetensors")
        with pytest.raises(ValueError, match=f"policy.safetensors.*{message}"):
            load_policy(tmp_path / "policy.safetensors")


def test_a_file_in_a_type_that_numpy_lacks_is_named(tmp_path):
    from safetensors.torch import save_file as save

    file = tmp_path / "policy.safetensors"
    save({name: torch.from_numpy(value).bfloat16() for name, value in tensors().items()}, file)
    with pytest.raises(ValueError, match="policy.safetensors.*save float32"):
        load_policy(file)


@pytest.mark.parametrize(
    "policy",
    [
        MeanPolicy.from_actor_state(mean_state()),
        RecurrentMeanPolicy.from_state(recurrent_state()),
        NumpyPolicy(tensors()),
    ],
)
def test_an_observation_of_another_robot_is_refused(policy):
    assert policy(np.zeros(3)).shape == (2,)
    for observation in (np.zeros(4), np.zeros((2, 2)), 0.0):
        with pytest.raises(ValueError, match=r"takes observations \[..., 3\], got shape"):
            policy(observation)
    for observation in ({"a": 1}, None, "left", [[1.0], [1.0, 2.0]]):
        with pytest.raises(ValueError, match=r"takes (one array|observations) \[..., 3\], got"):
            policy(observation)
    if isinstance(policy, RecurrentMeanPolicy):
        with pytest.raises(ValueError, match="one observation"):
            policy(np.zeros((2, 3)))
