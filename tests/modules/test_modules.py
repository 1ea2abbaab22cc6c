"""Activations and the policy factory."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from torchrl_tsallis.modules import Linear, RMSNorm, Squish, make_policy, squareplus, squish


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
