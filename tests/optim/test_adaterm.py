"""AdaTerm against a plain per-tensor reference, and its limits."""

from __future__ import annotations

import math
from copy import deepcopy

import pytest
import torch
from torch import nn

from torchrl_tsallis import AdaTerm

SHAPES = [(4, 3), (5,), (1,), ()]


def reference(param, grads, *, lr=1e-3, betas=(0.9, 0.9, 0.9), eps=1e-5, k=1.0, weight_decay=0.0, amsgrad=0.0,
              uncentered=False, adaptive_bias=False, ini_dof=None):  # fmt: skip
    """The equations, one tensor at a time, in Python's order."""
    theta, m, s = param.clone(), torch.zeros_like(param), torch.zeros_like(param)
    e = torch.full_like(param, eps**2)
    largest = torch.zeros_like(param)
    nu = ini_dof if ini_dof is not None else k + eps
    left1 = left2 = 1.0
    for t, g in enumerate(grads, start=1):
        d2 = (g - m) ** 2
        v = s + e
        if math.isinf(k):
            t1, t2, de = 1 - betas[0], 1 - betas[1], torch.full_like(e, eps**2)
        else:
            big_d = (d2 / v).mean().item()
            de = ((d2 - big_d * v) / nu).clamp_min(eps**2)
            w, w_max = (nu + 1) / (nu + big_d), (nu + 1) / nu
            t1, t2 = (1 - betas[0]) * w / w_max, (1 - betas[1]) * w / w_max
            w_nu = w - math.log(w)
            w_nu_max = max(w_max - math.log(w_max), -math.log(torch.finfo(param.dtype).tiny))
            t_nu = (1 - betas[2]) * w_nu / w_nu_max
            nu_new = ((nu + 2) / (nu + 1) + nu) / w_nu * (1 - k / nu) + k + eps
            nu += t_nu * (nu_new - nu)
        m = m + t1 * (g - m)
        s = s + t2 * (d2 - s)
        e = e + t2 * (de - e)
        left1, left2 = left1 * (1 - t1), left2 * (1 - t2)
        bias1, bias2 = (1 - left1, 1 - left2) if adaptive_bias else (1 - betas[0] ** t, 1 - betas[1] ** t)
        scale = s + e + (m**2 if uncentered else 0)
        if amsgrad:
            largest = torch.maximum(amsgrad * largest, scale)
            scale = largest
        theta = theta * (1 - lr * weight_decay)
        theta = theta - lr * (m / bias1) / (scale / bias2).sqrt()
    return theta


def run(params, grads, **kwargs):
    optimizer = AdaTerm(params, **kwargs)
    for row in grads:
        for p, g in zip(params, row, strict=True):
            p.grad = g.clone()
        optimizer.step()
    return optimizer


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"lr": 0.05, "betas": (0.8, 0.95, 0.7), "eps": 1e-3},
        {"weight_decay": 0.1},
        {"amsgrad": 1.0},
        {"amsgrad": 0.9},
        {"uncentered": True},
        {"adaptive_bias": True},
        {"ini_dof": 20.0},
        {"k": 2.5},
        {"k": math.inf},
        {"skip_nonfinite": False},
    ],
)
def test_equals_the_equations(kwargs):
    generator = torch.Generator().manual_seed(0)
    start = [torch.randn(shape, generator=generator, dtype=torch.float64) for shape in SHAPES]
    grads = [
        [
            torch.randn(shape, generator=generator, dtype=torch.float64) * (50 if step % 7 == 3 else 1)
            for shape in SHAPES
        ]
        for step in range(60)
    ]
    params = [nn.Parameter(x.clone()) for x in start]
    run(params, grads, **kwargs)
    plain = {key: value for key, value in kwargs.items() if key != "skip_nonfinite"}
    for i, p in enumerate(params):
        expected = reference(start[i], [row[i] for row in grads], **plain)
        torch.testing.assert_close(p.data, expected, rtol=1e-6, atol=1e-12)


def test_first_step_by_hand():
    # m = 0, v = eps^2: D = (g / eps)^2 = 100, so that t = 0.1 * nu / (nu + 100) with nu = 1.1
    p = nn.Parameter(torch.zeros(1, dtype=torch.float64))
    run([p], [[torch.ones(1, dtype=torch.float64)]], lr=1.0, eps=0.1)
    t = 0.1 * 1.1 / 101.1
    scale = t * 1.0 + (0.01 + t * (0.01 - 0.01))
    assert p.item() == pytest.approx(-(t / 0.1) / math.sqrt(scale / 0.1))


def test_without_robustness_uncentered_is_adam_like():
    # k = inf: m is a plain moving average; with a constant gradient its bias-corrected value is that gradient
    p = nn.Parameter(torch.zeros(3))
    run([p], [[torch.full((3,), 2.0)]] * 5, lr=0.1, k=math.inf, adaptive_bias=False)
    state = AdaTerm([p]).state
    assert not state
    torch.testing.assert_close(p.data, reference(torch.zeros(3), [torch.full((3,), 2.0)] * 5, lr=0.1, k=math.inf))


def test_an_outlier_moves_the_parameters_less_than_in_adam():
    def moved(make):
        p = nn.Parameter(torch.zeros(10))
        optimizer = make([p])
        generator = torch.Generator().manual_seed(0)
        for step in range(200):
            before = p.data.clone()
            p.grad = torch.randn(10, generator=generator) + (1000.0 if step == 199 else 0.0)
            optimizer.step()
        return (p.data - before).abs().mean().item()

    assert moved(lambda p: AdaTerm(p, lr=0.1)) < 0.5 * moved(lambda p: torch.optim.Adam(p, lr=0.1, betas=(0.9, 0.9)))


def test_members_of_an_ensemble_are_kept_apart():
    start, grads = torch.randn(3, 4, 2), torch.randn(20, 3, 4, 2)
    stacked = nn.Parameter(start.clone())
    run([stacked], [[g] for g in grads], batch_dims=1)
    for member in range(3):
        alone = nn.Parameter(start[member].clone())
        run([alone], [[g] for g in grads[:, member]])
        torch.testing.assert_close(stacked.data[member], alone.data)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e30])
def test_a_bad_gradient_leaves_no_trace(bad):
    grads = torch.randn(10, 4)
    clean, hit = nn.Parameter(torch.zeros(4)), nn.Parameter(torch.zeros(4))
    run([clean], [[g] for g in grads])
    rows = [[g] for g in grads]
    rows.insert(0, [torch.full((4,), bad)])
    rows.insert(6, [torch.tensor([0.0, bad, 0.0, 0.0])])
    optimizer = run([hit], rows)
    torch.testing.assert_close(hit.data, clean.data)
    assert optimizer.state[hit]["skipped"].item() == 2


def test_groups_missing_gradients_and_empty_tensors():
    a, b, c = nn.Parameter(torch.ones(2)), nn.Parameter(torch.ones(2)), nn.Parameter(torch.ones(0))
    optimizer = AdaTerm([{"params": [a, c]}, {"params": [b], "lr": 0.0}], lr=0.1)
    a.grad, b.grad, c.grad = torch.ones(2), torch.ones(2), torch.ones(0)
    optimizer.step()
    assert (a < 1).all()
    assert (b == 1).all()
    a.grad = None
    before = a.data.clone()
    optimizer.step()
    assert torch.equal(a.data, before)


@pytest.mark.parametrize("size", [1, 5])
def test_zero_and_constant_gradients_stay_finite(size):
    p = nn.Parameter(torch.zeros(size))
    run([p], [[torch.zeros(size)]] * 3 + [[torch.ones(size)]] * 2000)
    assert p.isfinite().all()
    assert (p < 0).all()


def test_state_dict_continues_bit_for_bit():
    grads = torch.randn(20, 6)
    whole, half = nn.Parameter(torch.ones(6)), nn.Parameter(torch.ones(6))
    run([whole], [[g] for g in grads], amsgrad=0.9)
    first = run([half], [[g] for g in grads[:10]], amsgrad=0.9)
    second = AdaTerm([half], amsgrad=0.9)
    second.load_state_dict(deepcopy(first.state_dict()))
    for g in grads[10:]:
        half.grad = g.clone()
        second.step()
    assert torch.equal(whole.data, half.data)


@pytest.mark.parametrize(
    "kwargs",
    [{"lr": -1.0}, {"betas": (0.9, 0.9)}, {"betas": (0.9, 1.0, 0.9)}, {"eps": 0.0}, {"k": 0.0}, {"weight_decay": -1.0},
     {"amsgrad": 2.0}, {"ini_dof": 0.5}, {"batch_dims": -1}],
)  # fmt: skip
def test_arguments_out_of_range(kwargs):
    with pytest.raises(ValueError, match=next(iter(kwargs))):
        AdaTerm([nn.Parameter(torch.zeros(1))], **kwargs)
