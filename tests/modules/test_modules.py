"""Activations and the policy factory."""

from __future__ import annotations

import math
import re

import pytest
import torch
from tensordict import TensorDict

from torchrl_tsallis.modules import (
    Linear,
    NoisyLSTM,
    NormalHead,
    RMSNorm,
    Squish,
    make_policy,
    make_recurrent_policy,
    squareplus,
    squish,
)


def test_squareplus_by_hand_and_extremes():
    x = torch.tensor([0.0, 1.5, -1.5, -1e9, 1e9])
    torch.testing.assert_close(squareplus(x), torch.tensor([1.0, 2.0, 0.5, 1e-9, 1e9]))
    x = torch.tensor([-1e9, 0.0, 1e9], requires_grad=True)
    squareplus(x).sum().backward()
    torch.testing.assert_close(x.grad, torch.tensor([0.0, 0.5, 1.0]))


def test_squish_is_x_times_the_derivative_of_squareplus():
    x = torch.linspace(-5, 5, 11, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(squareplus(x).sum(), x)
    torch.testing.assert_close(squish(x), x * slope)
    assert squish(torch.tensor(1.5)).item() == pytest.approx(1.2)
    assert torch.autograd.gradcheck(Squish(), (x,))


def test_squish_has_a_second_derivative_and_runs_under_vmap():
    x = torch.linspace(-5, 5, 12, dtype=torch.float64).view(3, 4).requires_grad_()
    assert torch.autograd.gradgradcheck(squish, (x,))
    torch.testing.assert_close(torch.vmap(squish)(x), squish(x))
    torch.testing.assert_close(torch.vmap(torch.func.grad(lambda y: squish(y).sum()))(x.detach()), _slope(squish, x))


def _slope(function, x):
    return torch.autograd.grad(function(x).sum(), x)[0]


def test_rms_norm_is_torchs():
    x = torch.randn(5, 7, dtype=torch.float64, requires_grad=True)
    ours, theirs = RMSNorm(7).double(), torch.nn.RMSNorm(7).double()
    with torch.no_grad():
        ours.weight.copy_(torch.rand(7)), theirs.weight.copy_(ours.weight)
    upstream = torch.randn(5, 7, dtype=torch.float64)
    for a, b in zip(
        torch.autograd.grad(ours(x), [x, ours.weight], upstream),
        torch.autograd.grad(theirs(x), [x, theirs.weight], upstream),
        strict=True,
    ):
        torch.testing.assert_close(a, b)
    torch.testing.assert_close(ours(x), theirs(x))
    assert list(ours.state_dict()) == list(theirs.state_dict())

    def norm(y, weight):
        return torch.func.functional_call(ours, {"weight": weight}, y)

    weight = ours.weight.detach().requires_grad_()
    assert torch.autograd.gradcheck(norm, (x, weight))
    assert torch.autograd.gradgradcheck(norm, (x, weight))
    zero = torch.zeros(2, 7, dtype=torch.float64, requires_grad=True)
    assert _slope(ours, zero).isfinite().all()


@pytest.mark.parametrize("shape", [(3, 6, 5), (3, 4, 6, 5)])
@pytest.mark.parametrize("make", [lambda: Linear(5, 5), lambda: Linear(5, 5, bias=False), lambda: RMSNorm(5)])
def test_stacked_parameters_are_those_of_the_members(make, shape):
    modules, x = [make() for _ in range(3)], torch.randn(shape)
    params = {name: torch.stack([m.get_parameter(name) for m in modules]) for name in modules[0].state_dict()}
    got = torch.func.functional_call(modules[0], params, x)
    by_vmap = torch.vmap(lambda p, y: torch.func.functional_call(modules[0], p, y))(params, x)
    torch.testing.assert_close(got, torch.stack([m(y) for m, y in zip(modules, x, strict=True)]))
    torch.testing.assert_close(by_vmap, got)


def test_policy_density_is_that_of_the_written_normal():
    policy = make_policy(4, 3)
    data = TensorDict({"observation": torch.randn(6, 4)}, [6])
    dist = policy.get_dist(data)
    policy(data)
    z = (data["action"] - data["loc"]) / data["scale"]
    expected = (-0.5 * z**2 - data["scale"].log() - 0.5 * math.log(2 * math.pi)).sum(-1)
    torch.testing.assert_close(dist.log_prob(data["action"]), expected)
    widths = [m.out_features for m in policy.modules() if isinstance(m, torch.nn.Linear)]
    assert widths == [100, 100, 6]


def test_policy_refuses_empty_dimensions():
    with pytest.raises(ValueError, match="obs_dim=0"):
        make_policy(0, 3)


HALF = [torch.bfloat16, torch.float16]


@pytest.mark.filterwarnings("ignore:Mismatch dtype")  # of torch.nn.RMSNorm
@pytest.mark.parametrize("dtype", HALF)
@pytest.mark.parametrize("scale", [1e-3, 0.05, 1.0, 300.0])
def test_rms_norm_in_half_precision_is_torchs(dtype, scale):
    x = (scale * torch.randn(5, 100)).to(dtype)
    for eps in (None, 1e-2):
        ours, theirs = RMSNorm(100, eps).to(dtype), torch.nn.RMSNorm(100, eps).to(dtype)
        assert ours(x).dtype == theirs(x).dtype == dtype
        torch.testing.assert_close(ours(x), theirs(x))
        ours, theirs = ours.float(), theirs.float()
        with torch.autocast("cpu", dtype):
            for y in (x, x.float()):
                assert ours(y).dtype == theirs(y).dtype
                torch.testing.assert_close(ours(y), theirs(y))


@pytest.mark.filterwarnings("ignore:Mismatch dtype")  # of torch.nn.RMSNorm
@pytest.mark.parametrize("dtype", HALF)
def test_gradients_of_rms_norm_in_half_precision_are_torchs(dtype):
    x, upstream = (0.01 * torch.randn(5, 100)).to(dtype), torch.randn(5, 100).to(dtype)
    for weight_dtype in (dtype, torch.float32):
        grads = []
        for module in (RMSNorm(100).to(weight_dtype), torch.nn.RMSNorm(100).to(weight_dtype)):
            given = x.clone().requires_grad_()
            with torch.autocast("cpu", dtype):
                grads.append(torch.autograd.grad(module(given), [given, module.weight], upstream))
        for ours, theirs in zip(*grads, strict=True):
            assert ours.dtype == theirs.dtype
            torch.testing.assert_close(ours.float(), theirs.float(), rtol=2e-2, atol=2e-2 * theirs.abs().max().item())


@pytest.mark.parametrize("dtype", HALF)
@pytest.mark.parametrize("function", [squish, squareplus])
def test_activations_in_half_precision_are_rounded_once(function, dtype):
    x = torch.tensor([-3e4, -300.0, -1.5, 0.0, 1e-3, 1.5, 300.0, 3e4], dtype=dtype, requires_grad=True)
    wide = x.detach().float().requires_grad_()
    assert torch.equal(function(x), function(wide).to(dtype))
    assert torch.equal(_slope(function, x), _slope(function, wide).to(dtype))
    assert function(x)[-2:].tolist() == pytest.approx(x[-2:].tolist(), rel=1e-3)  # float16 has no square of 300


@pytest.mark.parametrize("dtype", HALF)
def test_the_policy_under_autocast_writes_float32_within_a_percent(dtype):
    net = make_policy(28, 4).module[0].module
    for scale in (1.0, 0.1):
        x = scale * torch.randn(256, 28)
        exact = net(x)
        with torch.autocast("cpu", dtype):
            mixed = net(x)
        for a, b in zip(mixed, exact, strict=True):
            assert a.dtype == torch.float32
            assert (a - b).abs().mean() < 0.015 * b.abs().mean()


@pytest.mark.parametrize("dtype", HALF)
def test_stacked_layers_under_autocast_are_those_of_the_members(dtype):
    modules, x = [Linear(5, 5) for _ in range(3)], torch.randn(3, 6, 5)
    params = {name: torch.stack([m.get_parameter(name) for m in modules]) for name in modules[0].state_dict()}
    with torch.autocast("cpu", dtype):
        got = torch.func.functional_call(modules[0], params, x)
        expected = torch.stack([m(y) for m, y in zip(modules, x, strict=True)])
    assert got.dtype == expected.dtype == dtype
    torch.testing.assert_close(got, expected, rtol=2e-2, atol=2e-2)


DIMENSIONS = {
    "make_policy.obs_dim": lambda n: make_policy(n, 2),
    "make_policy.action_dim": lambda n: make_policy(3, n),
    "make_policy.hidden[1]": lambda n: make_policy(3, 2, hidden=(4, n)),
    "make_recurrent_policy.obs_dim": lambda n: make_recurrent_policy(n, 2),
    "make_recurrent_policy.action_dim": lambda n: make_recurrent_policy(3, n),
    "make_recurrent_policy.hidden_size": lambda n: make_recurrent_policy(3, 2, hidden_size=n),
    "make_recurrent_policy.num_layers": lambda n: make_recurrent_policy(3, 2, num_layers=n),
    "NoisyLSTM.hidden_size": lambda n: NoisyLSTM(3, n),
    "RMSNorm.size": lambda n: RMSNorm(n),
    "Linear.in_features": lambda n: Linear(n, 2),
    "Linear.out_features": lambda n: Linear(2, n),
}


@pytest.mark.parametrize("value", [None, True, "3", 2.5, math.nan, math.inf, -1, 0, []], ids=str)
@pytest.mark.parametrize("setting", DIMENSIONS)
def test_what_is_no_dimension_is_named(setting, value):
    with pytest.raises((TypeError, ValueError), match=re.escape(setting.partition(".")[2])):
        DIMENSIONS[setting](value)


@pytest.mark.parametrize("value", [None, "tanh", 64, 1.5], ids=str)
def test_hidden_widths_are_a_sequence(value):
    with pytest.raises(TypeError, match="^hidden must be a sequence"):
        make_policy(3, 2, hidden=value)


@pytest.mark.parametrize("value", [None, True, "1", math.nan, math.inf, -1e-3, [0.1]], ids=str)
@pytest.mark.parametrize(
    ("name", "make"),
    [("min_scale", NormalHead), ("min_scale", lambda x: make_recurrent_policy(3, 2, min_scale=x)),
     ("state_noise", lambda x: make_recurrent_policy(3, 2, state_noise=x)),
     ("eps", lambda x: RMSNorm(3, [] if x is None else x))],
)  # fmt: skip
def test_numbers_of_modules_are_checked(name, make, value):
    if isinstance(value, list):
        value = [0.1, 0.2]
    with pytest.raises((TypeError, ValueError), match=f"^{name} must be"):
        make(value)


@pytest.mark.parametrize("key", [None, 3, (), "", ("a", None)], ids=str)
@pytest.mark.parametrize("name", ["observation_key", "action_key"])
@pytest.mark.parametrize("make", [make_policy, make_recurrent_policy])
def test_keys_of_policies_are_checked(make, name, key):
    with pytest.raises((TypeError, ValueError), match=f"^{name} must be a key"):
        make(3, 2, **{name: key})


def test_a_head_needs_mean_and_scale_of_each_action():
    with pytest.raises(ValueError, match=r"\[4, 5\].*2 x the action"):
        NormalHead()(torch.zeros(4, 5))
