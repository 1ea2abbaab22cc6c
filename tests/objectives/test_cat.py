"""CAT-soft update against its equations and limits."""

from __future__ import annotations

import math

import pytest
import torch
from torchrl.objectives import SoftUpdate

from torchrl_tsallis import CATSoftUpdate, TsallisBCLoss
from torchrl_tsallis.modules import make_policy


def make_loss(**kwargs) -> TsallisBCLoss:
    torch.manual_seed(0)
    return TsallisBCLoss(make_policy(3, 2, hidden=(8,)), **kwargs)


def move(loss: TsallisBCLoss, seed: int, size: float = 0.1) -> None:
    generator = torch.Generator().manual_seed(seed)
    for p in loss.parameters():
        p.data += size * torch.randn(p.shape, generator=generator, dtype=torch.float32).to(p)


def target(loss: TsallisBCLoss) -> list[torch.Tensor]:
    params = loss.target_actor_network_params
    return [params.get(key).data.clone() for key in sorted(params.keys(True, True), key=str)]


def source(loss: TsallisBCLoss) -> list[torch.Tensor]:
    params = loss.actor_network_params
    return [params.get(key).data.clone() for key in sorted(params.keys(True, True), key=str)]


def test_plain_soft_update_is_the_limit():
    ours, theirs = make_loss(), make_loss()
    updater, soft = CATSoftUpdate(ours, tau=0.2, nu=math.inf, strength=0.0), SoftUpdate(theirs, tau=0.2)
    for step in range(5):
        move(ours, step)
        move(theirs, step)
        updater.step()
        soft.step()
    torch.testing.assert_close(target(ours), target(theirs))


@pytest.mark.parametrize("strength", [0.0, 0.5, 1.0])
def test_equals_the_equations(strength):
    tau, eps, k = 0.1, 1e-3, 1.0
    loss = make_loss().double()
    updater = CATSoftUpdate(loss, tau=tau, eps=eps, strength=strength, init_scale="eps")
    bars = target(loss)
    scales, nus = [torch.full_like(x, eps**2) for x in bars], [k + eps] * len(bars)
    for step in range(20):
        move(loss, step, size=1.0 if step == 10 else 0.01)
        thetas = source(loss)
        updater.step()
        expected = []
        for i, theta in enumerate(thetas):
            nu, d = nus[i], theta - bars[i]
            big_d = (d**2 / scales[i]).mean().item()
            w, w_max = (nu + 1) / (nu + big_d), (nu + 1) / nu
            t = tau * w / w_max
            w_nu = w - math.log(w)
            w_nu_max = max(w_max - math.log(w_max), -math.log(torch.finfo(torch.float64).tiny))
            star = ((nu + 2) / (nu + 1) + nu) / w_nu * (1 - k / nu) + k + eps
            extra = ((d**2 - big_d * scales[i]) / nu).clamp_min(eps**2)
            bars[i] = bars[i] + t * d
            scales[i] = scales[i] + t * (d**2 + extra - scales[i])
            nus[i] = nu + tau * w_nu / w_nu_max * (star - nu)
            expected.append(theta - strength * (tau - t) * d)
        torch.testing.assert_close(target(loss), bars, rtol=1e-9, atol=1e-12)
        torch.testing.assert_close(source(loss), expected, rtol=1e-9, atol=1e-12)


def test_starting_at_the_first_deviation_follows_at_once():
    followed = {}
    for start in ("first", "eps"):
        loss = make_loss()
        updater = CATSoftUpdate(loss, tau=0.1, strength=0.0, init_scale=start)
        before = target(loss)
        move(loss, 0)
        updater.step()
        followed[start] = sum((a - b).abs().sum().item() for a, b in zip(target(loss), before, strict=True))
    assert followed["first"] > 0.1 > 100 * followed["eps"]


def test_an_outlying_step_is_refused_and_consolidated():
    loss = make_loss()
    updater = CATSoftUpdate(loss, tau=0.1, strength=1.0)
    for step in range(50):
        move(loss, step, size=1e-3)
        updater.step()
    thetas, bars = source(loss), target(loss)
    move(loss, 99, size=10.0)
    jumped = source(loss)
    updater.step()
    gap = sum((a - b).abs().sum() for a, b in zip(jumped, bars, strict=True))
    moved = sum((a - b).abs().sum() for a, b in zip(target(loss), bars, strict=True))
    pulled = sum((a - b).abs().sum() for a, b in zip(source(loss), jumped, strict=True))
    assert moved < 0.01 * gap
    assert 0.05 * gap < pulled < 0.101 * gap
    assert len(thetas) == len(bars)


def test_no_change_keeps_the_target_and_everything_finite():
    loss = make_loss()
    updater = CATSoftUpdate(loss)
    before = target(loss)
    for _ in range(3):
        updater.step()
    torch.testing.assert_close(target(loss), before)
    assert all(x.isfinite().all() for x in [*target(loss), *source(loss)])


def test_a_loss_without_target_network_costs_nothing():
    loss = make_loss(gamma_mix=0.0)
    before = source(loss)
    updater = CATSoftUpdate(loss)
    updater.step()
    torch.testing.assert_close(source(loss), before)
    updater.load_state_dict(updater.state_dict())


def test_state_dict_continues_bit_for_bit():
    a, b = make_loss(), make_loss()
    one, two = CATSoftUpdate(a), CATSoftUpdate(b)
    for step in range(5):
        move(a, step)
        one.step()
    b.load_state_dict(a.state_dict())
    two.load_state_dict(one.state_dict())
    for step in range(5, 10):
        for loss, updater in ((a, one), (b, two)):
            move(loss, step)
            updater.step()
    assert all(torch.equal(x, y) for x, y in zip(target(a) + source(a), target(b) + source(b), strict=True))


def test_a_state_of_another_network_is_named():
    state = CATSoftUpdate(make_loss()).state_dict()
    other = CATSoftUpdate(TsallisBCLoss(make_policy(3, 2, hidden=(9,))))
    with pytest.raises(ValueError, match=r"bias has shape \[9\].*\[8\]"):
        other.load_state_dict(state)
    with pytest.raises(ValueError, match="same loss"):
        CATSoftUpdate(make_loss(gamma_mix=0.0)).load_state_dict(state)


@pytest.mark.parametrize(
    "kwargs", [{"tau": 0.0}, {"strength": 2.0}, {"eps": 0.0}, {"k": 0.0}, {"nu": 0.5}, {"init_scale": "zero"}]
)
def test_arguments_out_of_range(kwargs):
    with pytest.raises(ValueError, match=next(iter(kwargs))):
        CATSoftUpdate(make_loss(), **kwargs)
