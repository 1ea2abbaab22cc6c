"""Contract of TsallisBCLoss as a TorchRL loss and as the paper's equations."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import CompositeDistribution, InteractionType, TensorDictModule, set_composite_lp_aggregate
from torch import distributions as d
from torch import nn
from torchrl.modules import (
    IndependentNormal,
    OneHotCategorical,
    ProbabilisticActor,
    TanhNormal,
    TruncatedNormal,
)
from torchrl.objectives import SoftUpdate

from torchrl_tsallis import TsallisBCLoss
from torchrl_tsallis.modules import make_policy
from torchrl_tsallis.ratings import TsallisRating
from torchrl_tsallis.ratings.tsallis.equations import log_mixture, rating


def batch(*shape: int, dtype: torch.dtype = torch.float32) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    observation = torch.randn(*shape, 3, generator=generator, dtype=dtype)
    return TensorDict({"observation": observation, "action": observation[..., :2].tanh()}, shape)


def make_loss(**kwargs) -> TsallisBCLoss:
    torch.manual_seed(0)
    loss = TsallisBCLoss(make_policy(3, 2, hidden=(8,)), **kwargs)
    if loss.needs_target:
        SoftUpdate(loss, tau=0.1)
        with torch.no_grad():  # away from the policy, so that the target matters
            for value in loss.target_actor_network_params.values(True, True):
                value.mul_(0.9)
    return loss


def grads(loss: TsallisBCLoss, data: TensorDict) -> list[torch.Tensor]:
    out = loss(data)["loss_tsallis_bc"]
    return list(torch.autograd.grad(out.sum(), list(loss.parameters())))


def log_probs(loss: TsallisBCLoss, data: TensorDict, target: bool = False) -> torch.Tensor:
    params = loss.target_actor_network_params if target else loss.actor_network_params
    with params.to_module(loss.actor_network):
        return loss.actor_network.get_dist(data.copy()).log_prob(data["action"])


@pytest.mark.parametrize("gamma_mix", [0.0, 0.5, 1.0, "adaptive"])
def test_q_one_is_behavioral_cloning(gamma_mix):
    loss = make_loss(q=1.0, gamma_mix=gamma_mix)
    data = batch(7)
    out = loss(data)
    log_prob = log_probs(loss, data)
    torch.testing.assert_close(out["loss_tsallis_bc"], -log_prob.mean())
    torch.testing.assert_close(out["rating_mean"], torch.tensor(1.0))
    expected = torch.autograd.grad(-log_prob.mean(), list(loss.parameters()))
    torch.testing.assert_close(grads(loss, data), list(expected))


@pytest.mark.parametrize("gamma_mix", [0.0, 0.3, 1.0, "adaptive"])
def test_loss_gradient_and_statistics_by_the_equations(gamma_mix):
    loss = make_loss(q=0.7, gamma_mix=gamma_mix)
    data = batch(9)
    log_prob = log_probs(loss, data)
    moment = (0.3 * log_prob).exp().mean().detach()
    gamma = (1 - moment).clamp(0.1, 0.9) if gamma_mix == "adaptive" else torch.tensor(gamma_mix)
    reference = log_mixture(log_probs(loss, data, target=True), gamma).detach() if gamma_mix else torch.zeros(9)
    weights = rating(log_prob, reference, 0.7).detach()
    out = loss(data)
    expected = -((-0.3 * reference).exp() * ((0.3 * log_prob).exp() - 1) / 0.3).mean()
    torch.testing.assert_close(out["loss_tsallis_bc"], expected)
    torch.testing.assert_close(out["gamma_mix"], gamma)
    torch.testing.assert_close(out["rating_mean"], weights.mean())
    torch.testing.assert_close(out["rating_var"], weights.var(correction=0), rtol=1e-4, atol=1e-7)
    torch.testing.assert_close(out["ess"], weights.sum() ** 2 / weights.square().sum())
    torch.testing.assert_close(out["log_prob"], log_prob.mean().detach())
    if gamma_mix != 1:
        torch.testing.assert_close(out["bound"], moment / (1 - gamma))
    torch.testing.assert_close(loss.rating(data), weights)
    by_rating = torch.autograd.grad(-(weights * log_prob).mean(), list(loss.parameters()))
    torch.testing.assert_close(grads(loss, data), list(by_rating))


def test_only_the_loss_carries_a_gradient_and_the_input_stays():
    loss = make_loss()
    data = batch(4)
    before = data.clone()
    out = loss(data)
    assert [key for key, value in out.items() if value.requires_grad] == ["loss_tsallis_bc"]
    assert set(out.keys()) == set(loss.out_keys)
    assert set(data.keys()) == set(before.keys())
    assert (data == before).all()


def test_no_target_network_without_need():
    assert not any("target" in name for name, _ in make_loss(gamma_mix=0.0).named_buffers())
    assert any("target" in name for name, _ in make_loss(gamma_mix=0.2).named_buffers())
    assert not any("target" in name for name, _ in make_loss().named_parameters())


def test_reduction_and_mask():
    data = batch(3, 4)
    mask = torch.ones(3, 4, dtype=torch.bool)
    mask[1, 2:] = False
    data["observation"][1, 2:] = math.nan
    masked = data.clone().set(("collector", "mask"), mask)
    loss, flat = make_loss(), data[mask]
    torch.testing.assert_close(loss(masked), loss(flat))
    loss(masked)
    evidence, valid = loss.last_evidence
    torch.testing.assert_close(evidence[valid.mask], log_probs(loss, flat).detach())
    torch.testing.assert_close(grads(loss, masked), grads(loss, flat))
    summed = make_loss(reduction="sum")(masked)["loss_tsallis_bc"]
    torch.testing.assert_close(summed, loss(masked)["loss_tsallis_bc"] * mask.sum())
    none = make_loss(reduction="none")(masked)["loss_tsallis_bc"]
    assert none.shape == (3, 4)
    torch.testing.assert_close(none.sum(), summed)


def test_nested_keys_and_dispatch():
    actor = make_policy(3, 2, hidden=(8,), observation_key=("robot", "state"), action_key=("robot", "force"))
    loss = TsallisBCLoss(actor, gamma_mix=0.0)
    loss.set_keys(action=("robot", "force"))
    data = batch(5)
    nested = TensorDict({"robot": {"state": data["observation"], "force": data["action"]}}, [5])
    expected = loss(nested)
    assert loss.in_keys == [("robot", "force"), ("robot", "state")]
    got = loss(robot_force=data["action"], robot_state=data["observation"])
    torch.testing.assert_close(torch.stack(got), torch.stack([expected[k] for k in loss.out_keys]))
    loss.set_keys(action=None)
    assert loss.in_keys[0] == "action"


class _Parameters(nn.Module):
    """A linear layer that gives the parameters of a distribution under test."""

    def __init__(self, n_out: int, split: bool) -> None:
        super().__init__()
        self.linear, self.split = nn.Linear(3, n_out), split

    def forward(self, x):
        x = self.linear(x)
        if not self.split:
            return x
        loc, scale = x.chunk(2, -1)
        return loc, scale.exp()


@pytest.mark.parametrize(
    "distribution", [IndependentNormal, TanhNormal, TruncatedNormal, d.Categorical, OneHotCategorical]
)
def test_any_distribution(distribution):
    continuous = distribution not in (d.Categorical, OneHotCategorical)
    keys = ["loc", "scale"] if continuous else ["logits"]
    actor = ProbabilisticActor(
        TensorDictModule(_Parameters(4, continuous), in_keys=["observation"], out_keys=keys),
        in_keys=keys,
        distribution_class=distribution,
    )
    loss = TsallisBCLoss(actor, gamma_mix=0.0)
    data = batch(6)
    if not continuous:
        labels = torch.arange(6) % 4
        data["action"] = labels if distribution is d.Categorical else nn.functional.one_hot(labels, 4)
    out = loss(data)
    out["loss_tsallis_bc"].backward()
    assert all(value.isfinite().all() for value in out.values())
    assert all(p.grad.abs().sum() > 0 for p in loss.parameters())
    torch.testing.assert_close(out["log_prob"], log_probs(loss, data).mean().detach())


def test_composite_distribution():
    class Heads(nn.Module):
        def __init__(self):
            super().__init__()
            self.linear = nn.Linear(3, 5)

        def forward(self, x):
            x = self.linear(x)
            heads = TensorDict(
                {"arm": {"loc": x[..., :1], "scale": x[..., 1:2].exp()}, "grip": {"logits": x[..., 2:]}},
                x.shape[:-1],
            )
            return TensorDict({"action": heads}, x.shape[:-1])

    actor = ProbabilisticActor(
        TensorDictModule(Heads(), in_keys=["observation"], out_keys=["params"]),
        in_keys=["params"],
        out_keys=[("action", "arm"), ("action", "grip")],
        distribution_class=CompositeDistribution,
        distribution_kwargs={
            "distribution_map": {("action", "arm"): IndependentNormal, ("action", "grip"): d.Categorical},
        },
        default_interaction_type=InteractionType.RANDOM,
    )
    data = batch(4).exclude("action")
    data["action"] = TensorDict({"arm": torch.zeros(4, 1), "grip": torch.tensor([0, 1, 2, 0])}, [4])
    with set_composite_lp_aggregate(False):
        got = TsallisBCLoss(actor, q=1.0, gamma_mix=0.0)(data)["loss_tsallis_bc"]
    dist_params = actor.module[0](data.copy())["params", "action"]
    arm = IndependentNormal(**dist_params["arm"]).log_prob(torch.zeros(4, 1))
    grip = d.Categorical(logits=dist_params["grip", "logits"]).log_prob(data["action", "grip"])
    torch.testing.assert_close(got, -(arm + grip).mean())


@pytest.mark.parametrize("q", [1.0, 0.8, 0.0])
@pytest.mark.parametrize("gamma_mix", [0.0, 1.0, "adaptive"])
@pytest.mark.parametrize("distance", [0.0, 140.0, 1e4])
def test_extreme_densities_stay_finite(q, gamma_mix, distance):
    loss = make_loss(q=q, gamma_mix=gamma_mix)
    data = batch(5)
    data["action"][0] += distance
    out = loss(data)
    assert out["loss_tsallis_bc"].isfinite()
    assert all(g.isfinite().all() for g in grads(loss, data))


def test_one_sample_and_double():
    loss = make_loss().double()
    out = loss(batch(1, dtype=torch.float64))
    assert out["loss_tsallis_bc"].dtype == torch.float64
    assert out["ess"].item() == pytest.approx(1.0)


def test_vmap_over_stacked_parameters():
    members = [make_policy(3, 2, hidden=(8,)) for _ in range(3)]
    singles = [TsallisBCLoss(member, gamma_mix=0.0) for member in members]
    stacked = TensorDict.stack([TensorDict.from_module(single).data.clone() for single in singles])
    data = batch(3, 6)

    def run(params, td):
        with params.to_module(singles[0]):
            return singles[0](td)["loss_tsallis_bc"]

    got = torch.vmap(run)(stacked, data)
    expected = torch.stack([single(row)["loss_tsallis_bc"] for single, row in zip(singles, data, strict=True)])
    torch.testing.assert_close(got, expected.detach())


def test_compile_gives_the_same_loss():
    loss = make_loss()
    data = batch(6)
    expected = loss(data)
    got = torch.compile(loss, backend="eager", fullgraph=False)(data)
    torch.testing.assert_close(got, expected)


def test_state_dict_round_trip():
    loss = make_loss(q=0.7)
    other = TsallisBCLoss(make_policy(3, 2, hidden=(8,)), q=0.9)
    SoftUpdate(other, tau=0.1)
    other.load_state_dict(loss.state_dict())
    torch.testing.assert_close(other(batch(4)), loss(batch(4)))


def test_an_exchanged_reference_rates_against_the_peak():
    class Peak(TsallisRating):
        def log_reference(self, evidence, gamma):
            assert evidence.target_log_prob is None
            return evidence.dist.log_prob(evidence.dist.mean)

    loss = make_loss(rating=Peak(q=0.8, gamma_mix=0.0))
    data = batch(4)
    with loss.actor_network_params.to_module(loss.actor_network):
        dist = loss.actor_network.get_dist(data.copy())
    z2 = ((data["action"] - dist.mean) / dist.stddev).square().sum(-1)
    torch.testing.assert_close(loss.rating(data), (-0.1 * z2).exp().detach())


def test_errors_name_the_key_the_shape_and_the_fix():
    loss = make_loss(gamma_mix=0.0)
    with pytest.raises(KeyError, match="'action'.*set_keys"):
        loss(batch(4).exclude("action"))
    wrong = batch(4).exclude("action").set("action", torch.zeros(4, 1))
    with pytest.raises(ValueError, match=r"\[4, 1\].*\[4, 2\]"):
        loss(wrong)
    with pytest.raises(TypeError, match="float64"):
        loss(batch(4).set("action", torch.zeros(4, 2, dtype=torch.float64)))
    with pytest.raises(ValueError, match="empty"):
        loss(batch(0))
    with pytest.raises(RuntimeError, match="no batch"):
        _ = make_loss(gamma_mix=0.0).last_evidence


@pytest.mark.parametrize(
    "kwargs", [{"q": 1.2}, {"gamma_mix": "auto"}, {"gamma_mix": 2.0}, {"gamma_min": 0.0}, {"reduction": "max"}]
)
def test_settings_out_of_range(kwargs):
    with pytest.raises(ValueError, match=next(iter(kwargs))):
        TsallisBCLoss(make_policy(3, 2), **kwargs)
