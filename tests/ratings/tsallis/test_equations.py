"""Numerical contract of the method's equations."""

from __future__ import annotations

import math

import pytest
import torch
from torch.autograd import gradcheck

from torchrl_tsallis.ratings.tsallis import equations as F

LOG_X = [-1e4, -300.0, -20.0, -1.0, -1e-3, 0.0, 1e-3, 1.0, 20.0, 60.0]
QS = [1.0, 1 - 1e-9, 1 - 1e-6, 0.999, 0.95, 0.8, 0.6, 0.3, 0.0]


def reference_ln_q(log_x: float, q: float) -> tuple[float, float, float]:
    """Value and both derivatives in Python floats, by the closed forms or their limits."""
    u = 1 - q
    z = u * log_x
    if abs(z) < 1e-4:  # series in z, exact to float64
        phi = 1 + z / 2 + z * z / 6
        dphi = 0.5 + z / 3 + z * z / 8
        return log_x * phi, math.exp(z), -(log_x**2) * dphi
    value = math.expm1(z) / u
    return value, math.exp(z), -(log_x**2) * (z * math.exp(z) - math.expm1(z)) / z**2


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("q", QS)
def test_ln_q_value_and_gradients(q, dtype):
    log_x = torch.tensor(LOG_X, dtype=dtype, requires_grad=True)
    q_tensor = torch.tensor(q, dtype=dtype)
    for i, x in enumerate(LOG_X):
        q_leaf = q_tensor.clone().requires_grad_()
        value = F.ln_q(log_x[i], q_leaf)
        by_x, by_q = torch.autograd.grad(value, [log_x, q_leaf])
        expected = reference_ln_q(log_x[i].item(), q_tensor.item())
        # the exponent itself is rounded to 2^-24 relative, which exp() multiplies by |z|
        rtol = 1e-6 if dtype == torch.float64 else 1e-6 + 2e-7 * abs((1 - q) * x)
        for got, want in zip([value, by_x[i], by_q], expected, strict=True):
            assert math.isfinite(got.item())
            assert got.item() == pytest.approx(want, rel=rtol, abs=1e-38)


def test_ln_q_by_hand():
    torch.testing.assert_close(F.ln_q(torch.tensor([4.0, 0.25]).log(), 0.5), torch.tensor([2.0, -1.0]))
    torch.testing.assert_close(F.ln_q(torch.tensor([2.0]).log(), 0.0), torch.tensor([1.0]))
    assert F.ln_q(torch.tensor(-1e4), 0.8).item() == pytest.approx(-5.0)  # bounded below by -1 / (1 - q)


def test_ln_q_gradcheck_and_broadcast():
    log_x = torch.tensor([[-30.0], [-0.4], [0.0], [3.0]], dtype=torch.float64, requires_grad=True)
    q = torch.tensor([0.0, 0.5, 0.8, 0.99], dtype=torch.float64, requires_grad=True)
    assert F.ln_q(log_x, q).shape == (4, 4)
    assert gradcheck(F.ln_q, (log_x, q))


def test_ln_q_vmap():
    log_x, q = torch.randn(3, 5), torch.tensor([0.6, 0.8, 1.0])
    torch.testing.assert_close(torch.vmap(F.ln_q)(log_x, q), F.ln_q(log_x, q[:, None]))


@pytest.mark.parametrize("q", [1.0, 0.999, 0.8, 0.5])
def test_exp_q_inverts_ln_q(q):
    log_x = torch.tensor([-3.0, -0.1, 0.0, 0.2, 4.0], dtype=torch.float64)
    torch.testing.assert_close(F.exp_q(F.ln_q(log_x, q), q), log_x.exp())


def test_exp_q_cut_off_and_gradient():
    y = torch.tensor([-5.0, -2.0, 0.0], requires_grad=True)
    out = F.exp_q(y, 0.5)
    torch.testing.assert_close(out, torch.tensor([0.0, 0.0, 1.0]))
    out.sum().backward()
    torch.testing.assert_close(y.grad, torch.tensor([0.0, 0.0, 1.0]))


def test_log_mixture_by_hand_and_limits():
    log_prob = torch.tensor([-1e4, math.log(3.0), 60.0])
    torch.testing.assert_close(F.log_mixture(log_prob, 0.25)[:2], torch.tensor([math.log(0.75), math.log(1.5)]))
    assert F.log_mixture(log_prob, 0.25)[2].item() == pytest.approx(60 + math.log(0.25))
    torch.testing.assert_close(F.log_mixture(log_prob, 0.0), torch.zeros(3))
    torch.testing.assert_close(F.log_mixture(log_prob, 1.0), log_prob)


@pytest.mark.parametrize("gamma", [0.0, 0.1, 0.9, 1.0])
def test_log_mixture_gradient_is_finite_at_the_ends(gamma):
    log_prob = torch.tensor(LOG_X, requires_grad=True)
    level = torch.tensor(gamma, requires_grad=True)
    F.log_mixture(log_prob, level).sum().backward()
    assert log_prob.grad.isfinite().all()
    assert level.grad.isfinite()


def test_rating_by_hand():
    got = F.rating(torch.tensor([-2.0, 1.0]), torch.tensor([0.0, 3.0]), 0.5)
    torch.testing.assert_close(got, torch.tensor([-1.0, -1.0]).exp())
    torch.testing.assert_close(F.rating(torch.tensor([-1e4, 60.0]), 0.0, 1.0), torch.ones(2))
    assert F.rating(torch.tensor(60.0), torch.tensor(-1e4), 0.0).isfinite()


@pytest.mark.parametrize("q", QS)
@pytest.mark.parametrize("gamma", [0.0, 0.1, 0.9, 1.0])
def test_loss_gradient_is_minus_the_rating(q, gamma):
    log_prob = torch.tensor(LOG_X, requires_grad=True)
    reference = F.log_mixture(torch.tensor(LOG_X[::-1]), gamma)
    loss = F.tsallis_nll(log_prob, reference, q)
    (grad,) = torch.autograd.grad(loss.sum(), log_prob)
    assert loss.isfinite().all()
    torch.testing.assert_close(grad, -F.rating(log_prob.detach(), reference, q))


def test_loss_equals_the_paper_form_and_bc():
    log_prob, target = torch.tensor([-1.5, 0.3]).double(), torch.tensor([-1.0, 0.9]).double()
    reference = F.log_mixture(target, 0.4)
    paper = -((-0.2 * reference).exp()) * F.ln_q(log_prob, 0.8)
    torch.testing.assert_close(F.tsallis_nll(log_prob, reference, 0.8), paper)
    torch.testing.assert_close(F.tsallis_nll(log_prob, reference, 1.0), -log_prob)


@pytest.mark.parametrize("q", QS)
@pytest.mark.parametrize("gamma", [0.0, 0.1, 0.9, 1.0])
def test_rated_nll_is_the_loss_and_the_rating(q, gamma):
    log_prob = torch.tensor(LOG_X, dtype=torch.float64, requires_grad=True)
    reference = F.log_mixture(torch.tensor(LOG_X[::-1], dtype=torch.float64), gamma)
    loss, weight = F.rated_nll(log_prob, reference, q)
    (grad,) = torch.autograd.grad(loss.sum(), log_prob)
    torch.testing.assert_close(loss, F.tsallis_nll(log_prob, reference, q))
    torch.testing.assert_close(weight, F.rating(log_prob.detach(), reference, q))
    assert torch.equal(grad, -weight)
    assert not weight.requires_grad


def test_rated_nll_of_an_impossible_action_is_finite():
    log_prob = torch.tensor([-math.inf, -1.0], requires_grad=True)
    loss, _ = F.rated_nll(log_prob, 0.0, 0.8)
    loss.sum().backward()
    torch.testing.assert_close(loss[0].detach(), torch.tensor(5.0))  # 1 / (1 - q)
    assert log_prob.grad[0] == 0


def test_log_mixture_is_the_same_without_gradient():
    target = torch.tensor([-math.inf, *LOG_X])
    for gamma in (0.0, 0.1, 0.9, 1.0):
        with torch.no_grad():
            got = F.log_mixture(target, gamma)
        torch.testing.assert_close(got, F.log_mixture(target, gamma))


def test_loss_gradcheck():
    log_prob = torch.tensor([-3.0, 0.0, 2.0], dtype=torch.float64, requires_grad=True)
    reference = torch.tensor([0.1, -0.2, 0.4], dtype=torch.float64)
    assert gradcheck(lambda x: F.tsallis_nll(x, reference, 0.7), (log_prob,))


def test_adaptive_gamma_and_bound_by_hand():
    log_prob = torch.tensor([0.0, 2 * math.log(0.5)])  # at q = 0.5: pi^(1-q) is 1 and 1/2
    moment = F.density_moment(log_prob, 0.5)
    assert moment.item() == pytest.approx(0.75)
    assert F.adaptive_gamma(moment).item() == pytest.approx(0.25)
    assert F.bound_ratio(moment).item() == 1.0
    assert F.bound_ratio(torch.tensor(1.8)).item() == pytest.approx(2.0)
    assert F.bound_ratio(torch.tensor(0.05)).item() == pytest.approx(0.5)


def test_moment_per_member_and_one_sample():
    log_prob = torch.tensor([[0.0, -1e4], [60.0, 60.0]])
    got = F.density_moment(log_prob, torch.tensor([0.5, 1.0]))
    torch.testing.assert_close(got, torch.tensor([0.5, 1.0]))
    assert F.density_moment(torch.zeros(1), 0.8).item() == 1.0


def test_moment_of_nothing_is_an_error():
    with pytest.raises(ValueError, match="no sample"):
        F.density_moment(torch.zeros(0), 0.8)
