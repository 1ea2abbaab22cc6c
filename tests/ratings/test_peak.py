"""Contract of the peak rating and its score tuner."""

from __future__ import annotations

import math
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import distributions as d
from torch import nn
from torch.autograd import gradcheck
from torchrl.modules import IndependentNormal, ProbabilisticActor, TanhNormal
from torchrl.objectives import SoftUpdate

from torchrl_tsallis import PeakRating, QTuner, ScoreTuner, TsallisBCLoss
from torchrl_tsallis.modules import make_policy
from torchrl_tsallis.ratings import Batch, hyvarinen_score
from torchrl_tsallis.ratings.normal import DiagonalNormal, scale_weighted_log_prob, surprise_of
from torchrl_tsallis.ratings.peak import peak_value
from torchrl_tsallis.ratings.score_tuner import score_gradient

UNITS = [1e-3, 0.1, 10.0, 1e3]


class Fixed(nn.Module):
    """Mean and scale as parameters, the same for every observation."""

    def __init__(self, dims: int, loc: float = 0.0, scale: float = 1.0) -> None:
        super().__init__()
        self.loc = nn.Parameter(torch.full((dims,), loc))
        self.log_scale = nn.Parameter(torch.full((dims,), math.log(scale)))

    def forward(self, x):
        shape = (*x.shape[:-1], self.loc.shape[-1])
        return self.loc.expand(shape), self.log_scale.exp().expand(shape)


def fixed_actor(dims: int = 2, distribution=IndependentNormal, **kwargs) -> ProbabilisticActor:
    module = TensorDictModule(Fixed(dims, **kwargs), in_keys=["observation"], out_keys=["loc", "scale"])
    return ProbabilisticActor(module, in_keys=["loc", "scale"], distribution_class=distribution)


def data_of(action: torch.Tensor) -> TensorDict:
    observation = torch.zeros(*action.shape[:-1], 3, dtype=action.dtype)
    return TensorDict({"observation": observation, "action": action}, action.shape[:-1])


def test_loss_rating_and_gradient_by_hand():
    loss = TsallisBCLoss(fixed_actor(scale=2.0), rating=PeakRating(u=0.5, beta=0.0))
    action = torch.tensor([[2.0, 0.0], [4.0, -2.0]])
    out = loss(data_of(action))
    z = torch.tensor([1.0, 5.0])  # (2/2)^2 + 0, (4/2)^2 + (-2/2)^2
    rho = (-0.25 * z).exp()
    torch.testing.assert_close(loss.rating(data_of(action)), rho)
    torch.testing.assert_close(out["loss_tsallis_bc"], ((1 - rho) / 0.5).mean())
    out["loss_tsallis_bc"].backward()
    by_loc, by_log_scale = (p.grad for p in loss.parameters())
    torch.testing.assert_close(by_loc, -(rho[:, None] * action / 4).mean(0))
    torch.testing.assert_close(by_log_scale, -(rho[:, None] * ((action / 2).square() - 1)).mean(0))
    assert out["u"] == 0.5


def test_the_scale_weighted_likelihood_by_hand():
    loss = TsallisBCLoss(fixed_actor(scale=4.0), rating=PeakRating(u=0.0, beta=0.5))
    action = torch.tensor([[4.0, 0.0]])
    loss(data_of(action))["loss_tsallis_bc"].backward()
    by_loc, by_log_scale = (p.grad for p in loss.parameters())
    torch.testing.assert_close(by_loc, -4.0 * action[0] / 16)  # the scale itself, times (a - mu) / s^2
    torch.testing.assert_close(by_log_scale, -4.0 * torch.tensor([0.0, -1.0]))


def test_no_rejection_is_behavioral_cloning():
    torch.manual_seed(0)
    data = data_of(torch.randn(7, 2) * 100)
    peak = TsallisBCLoss(fixed_actor(), rating=PeakRating(u=0.0, beta=0.0))
    plain = TsallisBCLoss(fixed_actor(), q=1.0, gamma_mix=0.0)
    grads = [torch.autograd.grad(x(data)["loss_tsallis_bc"], list(x.parameters())) for x in (peak, plain)]
    torch.testing.assert_close(*grads)
    assert (peak.rating(data) == 1).all()


def test_the_fitted_variance_is_one_minus_u_of_a_normals():
    torch.manual_seed(0)
    action = 3.0 * torch.randn(4000, 1, dtype=torch.float64)
    loss = TsallisBCLoss(fixed_actor(1), rating=PeakRating(u=0.3, beta=0.0)).double()
    optimizer = torch.optim.LBFGS(loss.parameters(), max_iter=200, tolerance_grad=1e-10)

    def closure():  # the surrogate's value is no line search's friend: only its gradient is followed
        optimizer.zero_grad()
        out = loss(data_of(action))["loss_tsallis_bc"]
        out.backward()
        return out

    for _ in range(20):
        optimizer.step(closure)
    variance = (2 * loss.actor_network_params["module", "0", "module", "log_scale"]).exp().item()
    assert variance == pytest.approx(0.7 * action.square().mean().item(), rel=0.05)
    assert loss.rating_module.variance_share.item() == pytest.approx(0.7)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("unit", UNITS)
def test_ratings_and_the_tuner_have_no_unit(unit, dtype):
    torch.manual_seed(0)
    action = torch.randn(64, 2, dtype=dtype)
    action[::8] += 6.0
    results = []
    for factor in (1.0, unit):
        loss = TsallisBCLoss(fixed_actor(scale=factor), rating=PeakRating()).to(dtype)
        tuner = ScoreTuner(loss)
        data, us = data_of(action * factor), []
        for _ in range(5):
            loss(data)
            tuner.step()
            us.append(loss.rating_module.u.clone())
        results.append((loss.rating(data), torch.stack(us), loss.surprise(data)))
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other, rtol=2e-5, atol=1e-7)
    assert results[0][0][::8].max() < results[0][0][1::8].max()


@pytest.mark.parametrize("unit", UNITS)
def test_a_scale_that_does_not_fit_yet_rejects_nothing_in_common(unit):
    torch.manual_seed(0)
    action = torch.randn(256, 4) * unit
    action[:25] *= 30
    loss = TsallisBCLoss(make_policy(3, 4), rating=PeakRating())
    out = loss(data_of(action))
    assert out["ess"] > 25 and out["rating_mean"] > 0.01, "the network's first scale is about 1, whatever the unit"
    rating = loss.rating(data_of(action))
    assert rating[:25].median() <= rating[25:].median()


def test_calibrated_data_is_rated_by_the_plain_formula():
    torch.manual_seed(0)
    action = torch.randn(512, 8)
    action[:150] += 20.0  # 29 % gross outliers
    loss = TsallisBCLoss(fixed_actor(8), rating=PeakRating(u=0.2))
    assert 0.8 < loss(data_of(action))["distance"] < 2
    torch.testing.assert_close(loss.rating(data_of(action)), (-0.1 * action.square().sum(-1)).exp())


def test_hyvarinen_score_by_hand_and_by_its_definition():
    z = torch.tensor([1.0, 9.0], dtype=torch.float64)
    u, w = 0.2, torch.tensor([math.exp(-0.1), math.exp(-0.9)], dtype=torch.float64)
    expected = ((w * (0.4 * z - 4) + w.square() * z) / 2).mean()
    torch.testing.assert_close(hyvarinen_score(z, torch.tensor(u, dtype=torch.float64), 2), expected)

    # Of ln f = -(1 - rho) / u in one dimension: 2 (ln f)'' + (ln f)'^2, times s^2.
    x = torch.tensor(1.3, dtype=torch.float64, requires_grad=True)
    scale = 0.7
    log_f = -(1 - (-0.5 * u * (x / scale) ** 2).exp()) / u
    (first,) = torch.autograd.grad(log_f, x, create_graph=True)
    (second,) = torch.autograd.grad(first, x)
    by_definition = scale**2 * (2 * second + first**2)
    got = hyvarinen_score(((x / scale) ** 2).detach()[None], torch.tensor(u, dtype=torch.float64), 1)
    torch.testing.assert_close(got, by_definition.detach())


def test_the_scores_derivative():
    z = torch.tensor([[0.1, 2.0, 30.0], [5.0, 0.0, 400.0]], dtype=torch.float64)
    u = torch.tensor([0.05, 0.4], dtype=torch.float64, requires_grad=True)
    assert gradcheck(lambda value: hyvarinen_score(z, value, 3), (u,))
    score = hyvarinen_score(z, u, 3)
    (expected,) = torch.autograd.grad(score.sum(), u)
    value, slope = score_gradient(z, u.detach(), 3)
    torch.testing.assert_close(value, score.detach())
    torch.testing.assert_close(slope, expected)


@pytest.mark.parametrize(("outliers", "low", "high"), [(0.0, 0.0, 0.02), (0.1, 0.02, 0.5), (0.4, 0.02, 0.5)])
def test_u_runs_to_zero_on_clean_data_and_not_with_outliers(outliers, low, high):
    torch.manual_seed(0)
    action = torch.randn(2000, 4)
    action[: int(2000 * outliers)] += 7.0
    loss = TsallisBCLoss(fixed_actor(4), rating=PeakRating())
    tuner = ScoreTuner(loss, lr=0.03)
    for _ in range(600):
        loss(data_of(action))
        tuner.step()
    assert low < loss.rating_module.u.item() < high


@pytest.mark.parametrize("action", [1e20, -1e30, math.inf])
@pytest.mark.parametrize("beta", [0.0, 0.5])
def test_an_action_at_infinity_counts_for_nothing(action, beta):
    loss = TsallisBCLoss(make_policy(3, 2), rating=PeakRating(beta=beta))
    data = data_of(torch.zeros(4, 2))
    clean = torch.autograd.grad(loss(data[1:])["loss_tsallis_bc"], list(loss.parameters()))
    data["action"][0] = action
    out = loss(data)
    assert out["loss_tsallis_bc"].isfinite() and loss.rating(data)[0] == 0
    grads = torch.autograd.grad(out["loss_tsallis_bc"], list(loss.parameters()))
    torch.testing.assert_close([g * 4 / 3 for g in grads], list(clean))
    tuner = ScoreTuner(loss)
    assert tuner.step().isfinite() and loss.rating_module.u.isfinite()


def test_masked_and_stacked_samples_count_as_alone():
    torch.manual_seed(0)
    actors = [make_policy(3, 2, hidden=(8,)) for _ in range(3)]
    settings = [(0.2, 0.5), (0.1, 0.0), (0.0, 0.5)]
    singles = [
        TsallisBCLoss(a, rating=PeakRating(u=u, beta=b)) for a, (u, b) in zip(deepcopy(actors), settings, strict=True)
    ]
    us, betas = zip(*settings, strict=True)
    stacked = TsallisBCLoss(actors, rating=PeakRating(u=us, beta=betas))
    action = torch.randn(3, 9, 2)
    data = TensorDict({"observation": torch.randn(3, 9, 3), "action": action}, [3, 9])
    mask = torch.rand(3, 9) < 0.7
    data["collector", "mask"], data["action"][~mask] = mask, math.nan
    tuner = ScoreTuner(stacked, tuned=[True, True, False])
    out = stacked(data)
    grads = torch.autograd.grad(out["loss_tsallis_bc"], list(stacked.parameters()))
    for k, single in enumerate(singles):
        alone = torch.autograd.grad(single(data[k][mask[k]])["loss_tsallis_bc"], list(single.parameters()))
        torch.testing.assert_close([g[k] for g in grads], list(alone), rtol=1e-4, atol=1e-6)
    objective = tuner.step()
    for k, single in enumerate(singles):
        alone = single(data[k][mask[k]].exclude("collector"))
        for name in ("u", "distance", "rating_mean", "ess", "log_prob"):
            torch.testing.assert_close(out[name][k], alone[name])
        torch.testing.assert_close(out["member_loss"][k], alone["loss_tsallis_bc"].detach())
        if k < 2:
            torch.testing.assert_close(objective[k], ScoreTuner(single).step())
            torch.testing.assert_close(stacked.rating_module.u[k], single.rating_module.u)
    assert stacked.rating_module.u[2] == 0 and objective[2] == 0
    assert stacked.rating(data)[~mask].isnan().all() and not stacked.rating(data)[mask].isnan().any()


def test_tanh_normal_is_rated_in_its_base_space():
    loss = TsallisBCLoss(fixed_actor(distribution=TanhNormal), rating=PeakRating(u=0.4))
    base = torch.tensor([[0.5, -1.0], [0.0, 0.0]])
    expected = (-0.2 * base.square().sum(-1)).exp()
    torch.testing.assert_close(loss.rating(data_of(base.tanh())), expected, rtol=1e-4, atol=1e-5)
    loss(data_of(base.tanh()))
    assert ScoreTuner(loss).step().isfinite()


def test_other_distributions_have_a_fixed_u():
    module = TensorDictModule(nn.Linear(3, 4), in_keys=["observation"], out_keys=["logits"])
    actor = ProbabilisticActor(module, in_keys=["logits"], distribution_class=d.Categorical)
    loss = TsallisBCLoss(actor, rating=PeakRating(u=0.5, beta=0.0))
    data = TensorDict({"observation": torch.randn(6, 3), "action": torch.arange(6) % 4}, [6])
    probs = actor.get_dist(data.copy()).probs
    chosen = probs.gather(-1, data["action"][:, None])[:, 0]
    torch.testing.assert_close(loss.rating(data), (chosen / probs.max(-1).values).sqrt().detach())
    loss(data)["loss_tsallis_bc"].backward()
    plain = TsallisBCLoss(actor, rating=PeakRating(u=0.2, beta=0.0))
    plain(data)
    with pytest.raises(ValueError, match="diagonal normal.*fixed u"):
        ScoreTuner(plain).step()
    with pytest.raises(ValueError, match="beta"):
        TsallisBCLoss(actor, rating=PeakRating(u=0.5))(data)
    with pytest.raises(ValueError, match="diagonal normal"):
        loss.surprise(data)


def test_a_rating_does_not_depend_on_its_batch_and_may_go_in_chunks():
    torch.manual_seed(0)
    loss = TsallisBCLoss(make_policy(3, 2), rating=PeakRating())
    data = TensorDict({"observation": torch.randn(50, 3), "action": 100 * torch.randn(50, 2)}, [50])
    for _ in range(3):
        loss(data)
    whole = loss.rating(data)
    torch.testing.assert_close(loss.rating(data, chunk_size=7), whole)
    torch.testing.assert_close(loss.rating(data[:1]), whole[:1])
    with pytest.raises((TypeError, ValueError), match="chunk_size"):
        loss.rating(data, chunk_size=0)


def test_under_vmap_and_compiled_it_is_the_same():
    torch.manual_seed(0)
    loss = TsallisBCLoss(make_policy(3, 2, hidden=(8,)), rating=PeakRating())
    data = TensorDict({"observation": torch.randn(3, 6, 3), "action": torch.randn(3, 6, 2)}, [3, 6])
    expected = [loss(row)["loss_tsallis_bc"].detach() for row in data]
    params = TensorDict.stack([TensorDict.from_module(loss).data.clone() for _ in range(3)])

    def run(params, row):
        with params.to_module(loss):
            return loss(row)["loss_tsallis_bc"]

    torch.testing.assert_close(torch.vmap(run)(params, data), torch.stack(expected))
    got = torch.compile(loss, backend="eager")(data[0])["loss_tsallis_bc"]
    torch.testing.assert_close(got.detach(), expected[0])


def test_state_dict_continues_bit_for_bit():
    torch.manual_seed(0)
    data = data_of(torch.randn(20, 2))
    parts = []
    for _ in range(2):
        loss = TsallisBCLoss(fixed_actor(), rating=PeakRating())
        parts.append((loss, ScoreTuner(loss)))
    (loss, tuner), (other, second) = parts
    for _ in range(4):
        loss(data)
        tuner.step()
    other.load_state_dict(loss.state_dict())
    second.load_state_dict(deepcopy(tuner.state_dict()))
    for _ in range(3):
        assert torch.equal(loss(data)["distance"], other(data)["distance"])
        assert torch.equal(tuner.step(), second.step())
    assert torch.equal(loss.rating(data), other.rating(data))


def test_surprise_is_calibrated_in_decades():
    torch.manual_seed(0)
    z = torch.randn(200_000, 3).square().sum(-1)
    surprise = surprise_of(z, 3, torch.tensor(1.0))
    for decades in (1, 2, 3):
        share = (surprise >= decades).float().mean().item()
        assert share == pytest.approx(10.0**-decades, rel=0.25)
    # In two dimensions the survival function is exp(-z / 2), also where float64 holds it no more.
    far = torch.tensor([1000.0, 1e6, 1e9], dtype=torch.float64)
    torch.testing.assert_close(surprise_of(far, 2, torch.tensor(1.0)), far / 2 / math.log(10))
    ladder = surprise_of(torch.linspace(0, 5000, 2000), 8, torch.tensor(0.9))
    assert (ladder.diff() >= 0).all() and ladder.isfinite().all()


def test_a_loss_is_asked_for_surprises_with_the_fitted_share():
    loss = TsallisBCLoss(fixed_actor(), rating=PeakRating(u=0.2))
    data = data_of(torch.tensor([[3.0, 0.0], [0.0, 0.0]]))
    expected = torch.tensor([0.8 * 9 / 2 / math.log(10), 0.0])
    torch.testing.assert_close(loss.surprise(data), expected)
    plain = TsallisBCLoss(fixed_actor(), q=1.0, gamma_mix=0.0)
    torch.testing.assert_close(plain.surprise(data)[0], torch.tensor(9 / 2 / math.log(10)))
    mixed = TsallisBCLoss(fixed_actor(), gamma_mix=0.5)
    SoftUpdate(mixed, tau=0.1)
    with pytest.raises(NotImplementedError, match="gamma_mix=0"):
        mixed.surprise(data)


def test_a_tuner_that_does_not_fit_says_which_does():
    with pytest.raises(ValueError, match="QTuner tunes TsallisRating.*PeakRating.*ScoreTuner"):
        QTuner(TsallisBCLoss(fixed_actor(), rating=PeakRating()))
    with pytest.raises(ValueError, match="ScoreTuner tunes PeakRating.*QTuner"):
        ScoreTuner(TsallisBCLoss(fixed_actor()))
    with pytest.raises(ValueError, match="must start in"):
        ScoreTuner(TsallisBCLoss(fixed_actor(), rating=PeakRating(u=0.6)))
    with pytest.raises(ValueError, match="use TsallisBCLoss"):
        ScoreTuner(nn.Linear(2, 2))


@pytest.mark.parametrize("value", [None, -0.1, 1.5, math.nan, math.inf, "much", [], [0.1, None], True])
@pytest.mark.parametrize("name", ["u", "beta"])
def test_settings_out_of_range_are_named(name, value):
    with pytest.raises(ValueError, match=f"{name} must be a number in"):
        PeakRating(**{name: value})


def test_values_by_hand_at_the_limits():
    z = torch.tensor([0.0, 2.0, 1e9])
    value, weight = peak_value(z, torch.tensor(0.0))
    torch.testing.assert_close(value, z / 2)
    assert (weight == 1).all()
    value, weight = peak_value(z, torch.tensor(1e-8))
    torch.testing.assert_close(value[1], torch.tensor(1.0))
    value, weight = peak_value(z, torch.tensor(1.0))
    torch.testing.assert_close(value, torch.tensor([0.0, 1 - math.exp(-1), 1.0]))


def test_scale_weighted_likelihood_gradcheck():
    torch.manual_seed(0)
    loc, scale = torch.randn(4, 2, dtype=torch.float64), torch.rand(4, 2, dtype=torch.float64) + 0.5
    value = torch.randn(4, 2, dtype=torch.float64)
    beta, weight = torch.tensor(0.5, dtype=torch.float64), scale.detach().clone()

    def plain(loc, scale):  # the weight of the formula, held fixed
        z = (value - loc) / scale
        return (weight * (-0.5 * z.square() - scale.log())).sum(-1)

    inputs = [x.requires_grad_() for x in (loc, scale)]
    assert gradcheck(plain, inputs)
    expected = torch.autograd.grad(plain(*inputs).sum(), inputs)
    got = torch.autograd.grad(scale_weighted_log_prob(DiagonalNormal(value, *inputs), beta).sum(), inputs)
    torch.testing.assert_close(got, expected)


def test_means_over_processes_are_asked_for_once():
    calls = []

    def total(*values):  # two processes with the same samples
        calls.append(len(values))
        return [2 * value for value in values]

    batch = Batch(torch.tensor([True, True, False]), total=total, num_processes=2)
    first, second = batch.mean(torch.tensor([1.0, 3.0, math.nan]), torch.tensor([0.0, 4.0, math.nan]))
    assert (first, second, calls) == (2.0, 2.0, [3])
    torch.testing.assert_close(batch.share_of_mean(torch.tensor([1.0, 3.0, math.nan])), torch.tensor(2.0))
    assert calls == [3]
