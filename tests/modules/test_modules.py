"""Activations and the policy factory."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from torchrl_tsallis.modules import Squish, make_policy, squareplus, squish


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
