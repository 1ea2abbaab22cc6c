"""Contract of the q tuner."""

from __future__ import annotations

import math
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from torch.autograd import gradcheck

from torchrl_tsallis import QTuner, TsallisBCLoss
from torchrl_tsallis.modules import make_policy
from torchrl_tsallis.ratings.tsallis import q_gradient, q_objective, q_of_phi


def make_loss(gamma_mix: float | str = 0.0) -> TsallisBCLoss:
    return TsallisBCLoss(make_policy(3, 2, hidden=(8,)), gamma_mix=gamma_mix)


def objective_and_slope(log_prob: float, **kwargs) -> tuple[float, float]:
    phi = torch.zeros((), dtype=torch.float64, requires_grad=True)
    value = q_objective(torch.full((4,), log_prob, dtype=torch.float64), phi, **kwargs)
    value.backward()
    return value.item(), phi.grad.item()


def test_where_gamma_is_not_clipped_only_q_is_left():
    value, slope = objective_and_slope(-1.0)
    assert value == pytest.approx(0.8)
    assert slope == pytest.approx(0.4 * 0.25)  # dq/dphi at phi = 0


def test_clipped_gamma_by_hand():
    # ln pi = 1: E = exp(0.2) > 1, gamma = 0.1, and dq moves E by -E
    value, slope = objective_and_slope(1.0)
    moment = math.exp(0.2)
    assert value == pytest.approx(0.8 + 100 * (moment / 0.9 - 1))
    assert slope == pytest.approx(0.1 * (1 - 100 * moment / 0.9))


def test_fixed_gamma_by_hand():
    value, slope = objective_and_slope(-1.0, gamma=0.0)
    moment = math.exp(-0.2)
    assert value == pytest.approx(0.8 + 100 * (1 - moment))
    assert slope == pytest.approx(0.1 * (1 - 100 * moment))


def test_rounding_cannot_be_amplified():
    phi = torch.zeros(50, requires_grad=True)
    q_objective(torch.randn(50, 256) - 2, phi).sum().backward()
    torch.testing.assert_close(phi.grad, torch.full((50,), 0.1))


@pytest.mark.parametrize("log_prob", [-1e4, 60.0])
def test_extremes_are_finite(log_prob):
    assert all(math.isfinite(x) for x in objective_and_slope(log_prob))


def test_gradcheck_and_limits():
    log_prob = torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)
    phi = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    assert gradcheck(lambda p: q_objective(log_prob, p), (phi,))
    torch.testing.assert_close(q_of_phi(torch.tensor([-40.0, 0.0, 40.0]), 0.6), torch.tensor([0.6, 0.8, 1.0]))


@pytest.mark.parametrize("shift", [-1e4, -50.0, -2.0, -0.1, 0.4, 3.0, 60.0])
@pytest.mark.parametrize("gamma", [None, 0.0, 0.5])
def test_written_out_gradient_is_autograds(shift, gamma):
    log_prob = shift + torch.linspace(-0.5, 0.5, 24, dtype=torch.float64).reshape(2, 12)
    phi = torch.tensor([-0.7, 1.2], dtype=torch.float64, requires_grad=True)
    expected = q_objective(log_prob, phi, gamma=gamma)
    expected.sum().backward()
    value, slope = q_gradient(log_prob, phi, gamma=gamma)
    torch.testing.assert_close(value, expected.detach(), rtol=1e-12, atol=0)
    torch.testing.assert_close(slope, phi.grad, rtol=1e-10, atol=1e-300)
    assert not slope.requires_grad


@pytest.mark.parametrize(("log_prob", "direction"), [(-2.0, -1), (5.0, 1)])
def test_q_falls_until_the_constraint_binds(log_prob, direction):
    loss = make_loss("adaptive")
    tuner = QTuner(loss)
    for _ in range(400):
        tuner.step(torch.full((16,), log_prob))
    assert direction * (loss.q.item() - 0.8) > 1e-3


def test_step_reads_the_last_batch_and_leaves_the_policy_alone():
    loss = make_loss()
    tuner = QTuner(loss)
    loss(TensorDict({"observation": torch.randn(6, 3), "action": torch.zeros(6, 2)}, [6]))["loss_tsallis_bc"].backward()
    before = [p.grad.clone() for p in loss.parameters()]
    expected = q_objective(loss.last_evidence[0], torch.tensor(0.0), gamma=0.0)
    torch.testing.assert_close(tuner.step(), expected)
    torch.testing.assert_close([p.grad for p in loss.parameters()], before)
    assert not any(p is tuner.phi for p in loss.parameters())


def test_state_dict_continues_bit_for_bit():
    log_probs = torch.randn(10, 32)
    tuner = QTuner(make_loss())
    for row in log_probs[:5]:
        tuner.step(row)
    other = QTuner(make_loss())
    other.load_state_dict(deepcopy(tuner.state_dict()))
    assert torch.equal(other.loss.q, tuner.loss.q)
    for row in log_probs[5:]:
        assert torch.equal(tuner.step(row), other.step(row))
    assert torch.equal(other.phi, tuner.phi)


def test_errors():
    with pytest.raises(ValueError, match="gamma_mix < 1"):
        QTuner(make_loss(1.0))
    with pytest.raises(ValueError, match="q_min"):
        QTuner(make_loss(), q_min=1.0)
    with pytest.raises(ValueError, match="multiplier"):
        QTuner(make_loss(), multiplier=-1.0)


@pytest.mark.parametrize("away", [1e-3, 1e-5, 1e-7, 1e-9])
@pytest.mark.parametrize("shift", [-3.0, 2.0])
def test_the_sign_is_right_however_close_q_is_to_one(away, shift):
    log_prob = shift + torch.linspace(-1, 1, 11, dtype=torch.float64)
    phi = torch.logit(torch.tensor(1 - away / 0.4, dtype=torch.float64))
    exact = q_gradient(log_prob, phi, gamma=0.0)
    value, slope = q_gradient(log_prob.float(), phi.float(), gamma=0.0)
    torch.testing.assert_close(slope.double(), exact[1], rtol=2e-2, atol=0)
    assert slope.sign() == exact[1].sign()


def test_densities_of_zero_are_no_trouble():
    value, slope = q_gradient(torch.tensor([-math.inf, 0.0, 1.0]), torch.tensor(0.0))
    assert value.isfinite() and slope.isfinite()
