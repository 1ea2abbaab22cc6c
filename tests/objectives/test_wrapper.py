"""Contract of the loss that rates the samples of another one."""

from __future__ import annotations

import math
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.modules import DiffusionActor
from torchrl.modules.models import ACTModel
from torchrl.objectives import ACTLoss, BCLoss, DiffusionBCLoss

from torchrl_tsallis import PeakRating, RatedLoss, ScoreTuner, TsallisBCLoss, TsallisRating
from torchrl_tsallis.evaluation import auroc
from torchrl_tsallis.modules import make_policy
from torchrl_tsallis.ratings.score_tuner import score_gradient
from torchrl_tsallis.trainers import make_offline_trainer

UNITS = [1e-3, 0.1, 10.0, 1e3]


class Constant(nn.Module):
    """The same action for every observation."""

    def __init__(self, dims: int) -> None:
        super().__init__()
        self.action = nn.Parameter(torch.zeros(dims))

    def forward(self, x):
        return self.action.expand(*x.shape[:-1], -1)


def bc_loss(net: nn.Module, loss_function="l2", **kwargs) -> BCLoss:
    actor = TensorDictModule(net, in_keys=["observation"], out_keys=["action"])
    return BCLoss(actor, loss_function=loss_function, **{"reduction": "none"} | kwargs)


def diffusion_loss(**kwargs) -> DiffusionBCLoss:
    net = nn.Sequential(nn.Linear(2 + 3 + 1, 16), nn.SiLU(), nn.Linear(16, 2))
    return DiffusionBCLoss(
        DiffusionActor(2, score_network=net, num_steps=10, beta_start=0.01, beta_end=0.4),
        **{"reduction": "none"} | kwargs,
    )


def act_loss(**kwargs) -> ACTLoss:
    layers = {"num_encoder_layers": 1, "num_decoder_layers": 1, "latent_dim": 2}
    model = ACTModel(3, 2, chunk_size=4, hidden_dim=8, nheads=2, **layers)
    keys = {"in_keys": ["observation", "action_chunk"], "out_keys": ["action_pred", "mu", "log_var"]}
    return ACTLoss(TensorDictModule(model, **keys), kl_weight=0.1, **{"reduction": "none"} | kwargs)


def data_of(action: torch.Tensor) -> TensorDict:
    observation = torch.zeros(*action.shape[:-1], 3, dtype=action.dtype)
    return TensorDict({"observation": observation, "action": action}, action.shape[:-1])


def random_data(n: int) -> TensorDict:
    data = TensorDict({"observation": torch.randn(n, 3), "action": torch.randn(n, 2)}, [n])
    data["vla_action", "chunk"] = torch.randn(n, 4, 2)
    return data


MAKE = {
    "bc": lambda: RatedLoss(bc_loss(nn.Linear(3, 2))),
    "diffusion": lambda: RatedLoss(diffusion_loss()),
    "act": lambda: RatedLoss(act_loss(), loss_key="loss_act"),
}


def linear_task(outliers: float, n: int = 1024, dims: int = 4, unit: float = 1.0):
    """Actions linear in the observation with a normal noise of 0.1, some of them replaced by something far off."""
    generator = torch.Generator().manual_seed(0)
    weight = torch.randn(3, dims, generator=generator)
    observation = torch.randn(n, 3, generator=generator)
    action = observation @ weight + 0.1 * torch.randn(n, dims, generator=generator)
    bad = torch.arange(n) < int(outliers * n)
    action[bad] = 3.0 + torch.randn(int(bad.sum()), dims, generator=generator)
    return TensorDict({"observation": observation, "action": action * unit}, [n]), weight * unit, bad


def fit(loss, data, steps: int = 600, lr: float = 0.05, tuner_lr: float = 0.03) -> ScoreTuner:
    optimizer, tuner = torch.optim.Adam(loss.parameters(), lr=lr), ScoreTuner(loss, lr=tuner_lr)
    for _ in range(steps):
        optimizer.zero_grad()
        loss(data)["loss_bc"].backward()
        optimizer.step()
        tuner.step()
    return tuner


def test_loss_rating_scale_and_gradient_by_hand():
    loss = RatedLoss(bc_loss(Constant(2)), rating=PeakRating(u=0.5))
    loss.scale.value.fill_(2.0)
    loss.scale.batches.fill_(1)
    action = torch.tensor([[2.0, 0.0], [1.0, -1.0], [3.0, 3.0]])
    out = loss(data_of(action))
    sample = torch.tensor([2.0, 1.0, 9.0])  # means of the squares over the two dimensions
    rho = (-0.25 * sample).exp()  # Z = 2 l / 2, exp(-u Z / 2)
    torch.testing.assert_close(loss.last_evidence[0], sample)
    torch.testing.assert_close(out["loss_bc"], (2 * 2.0 / (0.5 * 2) * (1 - rho)).mean())
    out["loss_bc"].backward()
    (param,) = loss.parameters()
    torch.testing.assert_close(param.grad, -(rho[:, None] * action).mean(0))  # of the mean square over 2 dimensions
    torch.testing.assert_close(loss.scale.value, 2 + 0.02 * ((rho * sample).sum() / rho.sum() - 2))
    assert out["u"] == 0.5
    torch.testing.assert_close(out["rating_mean"], rho.mean())
    torch.testing.assert_close(out["ess"], rho.sum() ** 2 / rho.square().sum())


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_no_rejection_is_the_wrapped_loss(reduction):
    torch.manual_seed(0)
    net, data = nn.Linear(3, 2), random_data(7)
    rated = RatedLoss(bc_loss(net), rating=PeakRating(u=0.0), reduction=reduction)
    sample = bc_loss(net)(data)["loss_bc"].mean(-1)
    expected = {"mean": sample.mean(), "sum": sample.sum(), "none": sample}[reduction]
    got = rated(data)["loss_bc"]
    torch.testing.assert_close(got, expected)
    grads = [torch.autograd.grad(x.sum(), list(net.parameters())) for x in (got, expected)]
    torch.testing.assert_close(*grads)
    if reduction == "mean":
        torch.testing.assert_close(got, bc_loss(net, reduction="mean")(data)["loss_bc"])


def test_it_is_the_loop_written_by_hand():
    torch.manual_seed(0)
    data, _, _ = linear_task(0.2, n=64)
    net = nn.Linear(3, 4)
    twin = deepcopy(net)
    loss = RatedLoss(bc_loss(net), rate=0.02)
    optimizer, tuner = torch.optim.SGD(loss.parameters(), lr=0.1), ScoreTuner(loss, optimizer=sgd)
    other = torch.optim.SGD(twin.parameters(), lr=0.1)
    phi, scale, dims = torch.tensor(0.2 / 0.5).logit(), None, 4
    for _ in range(20):
        optimizer.zero_grad()
        out = loss(data)
        out["loss_bc"].backward()
        optimizer.step()
        tuner.step()

        r2 = (twin(data["observation"]) - data["action"]).square().sum(-1)
        s2 = (r2.detach() / dims).log().mean().exp() if scale is None else scale
        z = r2.detach() / s2
        typical = 1 / (1 / (1 + z / dims)).mean() - 1
        z = z / max(1.0, typical.item() / 2)
        u = 0.5 * phi.sigmoid()
        w = (-u * z / 2).exp()
        mean = (w * r2.detach() / dims).sum() / w.sum()
        scale = mean if scale is None else scale + 0.02 * (mean - scale)
        other.zero_grad()
        (w * r2 / dims).mean().backward()
        other.step()
        phi = phi - 0.5 * score_gradient(z, u, dims)[1] * u * (1 - phi.sigmoid())
        torch.testing.assert_close(out["u"], u)
        torch.testing.assert_close(loss.scale.value, scale)
    torch.testing.assert_close(list(net.parameters()), list(twin.parameters()))


def sgd(params):
    return torch.optim.SGD(params, lr=0.5)


@pytest.mark.parametrize("outliers", [0.1, 0.3])
def test_outliers_are_rejected_and_the_regression_is_that_of_clean_data(outliers):
    torch.manual_seed(0)
    data, weight, bad = linear_task(outliers)
    loss, plain = RatedLoss(bc_loss(nn.Linear(3, 4))), bc_loss(nn.Linear(3, 4), reduction="mean")
    fit(loss, data)
    optimizer = torch.optim.Adam(plain.parameters(), lr=0.05)
    for _ in range(600):
        optimizer.zero_grad()
        plain(data)["loss_bc"].backward()
        optimizer.step()
    error, plain_error = (
        (x.actor_network.module.weight.T - weight).abs().max().item() for x in (loss.loss_module, plain)
    )
    clean = torch.linalg.lstsq(with_one(data["observation"][~bad]), data["action"][~bad]).solution[:3]
    assert error < 2 * (clean - weight).abs().max().item() + 0.005 < plain_error / 5
    rating = loss.rating(data)
    assert rating[bad].quantile(0.95) < 0.01 and rating[~bad].median() > 0.7
    assert auroc(-rating[bad].numpy(), -rating[~bad].numpy()) > 0.99
    assert loss.scale.value.item() == pytest.approx(0.01, rel=0.3), "the square of the noise"


def with_one(x):
    return torch.cat([x, torch.ones(len(x), 1)], 1)


def test_u_runs_to_zero_on_clean_data():
    torch.manual_seed(0)
    data, _, _ = linear_task(0.0)
    loss = RatedLoss(bc_loss(nn.Linear(3, 4)))
    fit(loss, data)
    assert loss.rating_module.u.item() < 0.02
    assert loss.rating(data).median() > 0.95


@pytest.mark.parametrize("unit", UNITS)
def test_ratings_and_the_tuner_have_no_unit(unit):
    torch.manual_seed(0)
    data, _, bad = linear_task(0.2, n=64)
    net, results = nn.Linear(3, 4), []
    for factor in (1.0, unit):
        scaled = data.clone()
        scaled["action"] *= factor
        own = deepcopy(net)
        with torch.no_grad():
            for p in own.parameters():
                p.mul_(factor)
        loss = RatedLoss(bc_loss(own))
        optimizer, tuner = torch.optim.SGD(loss.parameters(), lr=0.5), ScoreTuner(loss, lr=0.03)
        us = []
        for _ in range(50):
            optimizer.zero_grad()
            loss(scaled)["loss_bc"].backward()
            optimizer.step()
            tuner.step()
            us.append(loss.rating_module.u.clone())
        results.append((loss.rating(scaled), torch.stack(us), loss.scale.value / factor**2))
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-5)
    assert results[0][0][bad].max() < results[0][0][~bad].median()


def with_padding(data: TensorDict) -> tuple[TensorDict, torch.Tensor]:
    mask, padded = torch.arange(len(data)) % 3 != 0, data.clone()
    padded["collector", "mask"] = mask[:, None]
    for key in ("observation", "action", ("vla_action", "chunk")):
        padded.get(key)[~mask] = math.nan
    return padded, mask


def test_padding_counts_for_nothing():
    torch.manual_seed(0)
    loss, data = MAKE["bc"](), random_data(12)
    padded, mask = with_padding(data)
    results = []
    for batch in (padded, data[mask]):
        twin = deepcopy(loss)
        out = twin(batch)
        grads = torch.autograd.grad(out["loss_bc"], list(twin.parameters()))
        results.append((dict(out.detach().items()), grads, twin.scale.value))
    torch.testing.assert_close(*results)
    rating = twin.rating(padded)
    assert rating[~mask].isnan().all() and not rating[mask].isnan().any()
    none = RatedLoss(twin.loss_module, reduction="none")(padded)["loss_bc"]
    assert (none[~mask] == 0).all() and (none[mask] > 0).all()


@pytest.mark.parametrize("kind", ["diffusion", "act"])
def test_padding_reaches_no_gradient_of_losses_that_know_no_masks(kind):
    torch.manual_seed(0)
    loss = MAKE[kind]()
    padded, mask = with_padding(random_data(12))
    out = loss(padded)
    grads = torch.autograd.grad(out[loss.loss_key], list(loss.parameters()), allow_unused=True)
    assert all(g.isfinite().all() for g in grads if g is not None)
    assert all(value.isfinite() for value in out.values()) and loss.scale.value.isfinite()
    assert out["ess"] <= mask.sum()
    assert torch.equal(loss.rating(padded).isnan(), ~mask)


@pytest.mark.parametrize("value", [1e20, -1e30, math.inf])
@pytest.mark.parametrize("u", [0.0, 0.2])
@pytest.mark.parametrize("kind", MAKE)
def test_an_action_at_infinity_counts_for_nothing(kind, u, value):
    torch.manual_seed(0)
    loss, data = MAKE[kind](), random_data(6)
    loss.rating_module.u.fill_(u)
    data["action"][0] = data["vla_action", "chunk"][0] = value
    out = loss(data)
    assert out[loss.loss_key].isfinite() and loss.scale.value.isfinite()
    grads = torch.autograd.grad(out[loss.loss_key], list(loss.parameters()), allow_unused=True)
    assert all(g.isfinite().all() for g in grads if g is not None)
    assert u == 0 or loss.rating(data)[0] == 0
    assert u == 0 or ScoreTuner(loss).step().isfinite()


def test_nan_in_a_sample_reaches_the_guard_and_not_the_scale():
    torch.manual_seed(0)
    loss, data = MAKE["bc"](), random_data(6)
    loss(data)
    before = loss.scale.value.clone()
    data["action"][0] = math.nan
    assert loss(data)["loss_bc"].isnan()
    assert torch.equal(loss.scale.value, before)


def test_state_dict_continues_bit_for_bit():
    torch.manual_seed(0)
    data, net = random_data(20), nn.Linear(3, 2)
    (loss, tuner), (other, second) = (
        (x, ScoreTuner(x)) for x in (RatedLoss(bc_loss(net)), RatedLoss(bc_loss(deepcopy(net))))
    )
    for _ in range(4):
        loss(data)
        tuner.step()
    other.load_state_dict(loss.state_dict())
    second.load_state_dict(deepcopy(tuner.state_dict()))
    for _ in range(3):
        assert torch.equal(loss(data)["loss_bc"], other(data)["loss_bc"])
        assert torch.equal(tuner.step(), second.step())
        assert torch.equal(loss.scale.value, other.scale.value)
    assert torch.equal(loss.rating(data), other.rating(data))


def test_a_rating_does_not_depend_on_its_batch_and_puts_modes_back():
    torch.manual_seed(0)
    net = nn.Sequential(nn.Linear(3, 8), nn.Dropout(0.5), nn.Linear(8, 2))
    loss, data = RatedLoss(bc_loss(net)), random_data(50)
    with pytest.warns(UserWarning, match="no batch was seen"):
        loss.rating(data)
    loss(data)
    whole, scale = loss.rating(data), loss.scale.value.clone()
    torch.testing.assert_close(loss.rating(data, chunk_size=7), whole)
    torch.testing.assert_close(loss.rating(data[:1]), whole[:1])
    assert net.training and loss.training and torch.equal(loss.scale.value, scale)
    loss.eval()
    assert not net.training
    loss(data)
    assert torch.equal(loss.scale.value, scale), "frozen in evaluation"


@pytest.mark.parametrize("kind", ["diffusion", "act"])
def test_a_rating_is_the_mean_of_seeded_draws(kind):
    torch.manual_seed(0)
    loss, data = MAKE[kind](), random_data(40)
    loss(data)
    loss.rating_module.u.fill_(0.2)
    state = torch.get_rng_state()
    one, many = loss.rating(data), [loss.rating(data, draws=64, seed=seed) for seed in (0, 0, 1)]
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.equal(many[0], many[1]) and not torch.equal(many[0], many[2])
    single = [loss.rating(data, seed=seed) for seed in (0, 1)]
    assert torch.equal(single[0], one)
    loss.dims, loss.draws = loss.rating_module.dims, 64
    assert torch.equal(loss.rating(data), many[0]), "as in training, if nothing is said"
    assert (many[0] - many[2]).abs().mean() < 0.4 * (single[0] - single[1]).abs().mean()


@pytest.mark.parametrize("kind", MAKE)
def test_it_trains_in_torchrls_trainer_with_its_tuner(kind, tmp_path):
    torch.manual_seed(0)
    loss = MAKE[kind]()
    wrapped = list(loss.loss_module.parameters())
    assert [id(p) for p in loss.parameters()] == [id(p) for p in wrapped], "no copies"
    before = [p.detach().clone() for p in wrapped]
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(64), batch_size=16)
    buffer.extend(random_data(64))
    trainer = make_offline_trainer(
        loss,
        buffer,
        torch.optim.Adam(loss.parameters(), lr=1e-3),
        steps=8,
        log_every=4,
        tuner=ScoreTuner(loss),
        checkpoint_dir=tmp_path,
        checkpoint_every=4,
        progress=False,
    )
    trainer.train()
    assert any(not torch.equal(p, old) for p, old in zip(wrapped, before, strict=True))
    assert loss.rating_module.u != 0.2 and loss.scale.batches == 8
    rating = loss.rating(random_data(5))
    assert rating.shape == (5,) and ((rating > 0) & (rating <= 1)).all()


def test_extra_passes_rate_without_changing_the_gradients_pass():
    torch.manual_seed(0)
    net = diffusion_loss()
    data = random_data(200)
    grads = []
    for draws in (0, 3):
        loss = RatedLoss(deepcopy(net), rating=PeakRating(u=0.0), draws=draws)
        torch.manual_seed(1)
        out = loss(data)
        grads.append(torch.autograd.grad(out["loss_diffusion_bc"], list(loss.parameters())))
        assert loss.rating_module.dims == (2 if draws == 0 else 6)
    torch.testing.assert_close(*grads)  # with u = 0 every sample counts 1, whatever it was rated by

    torch.manual_seed(1)
    loss(data)
    torch.manual_seed(1)
    net(data)
    mean = torch.stack([net(data)["loss_diffusion_bc"].mean(-1) for _ in range(3)]).mean(0)
    distance, _ = loss.last_evidence
    torch.testing.assert_close(distance / distance.mean(), (mean / mean.mean()).detach())


@pytest.mark.parametrize("kind", MAKE)
def test_random_losses_are_rejected_where_their_actions_are_far_off(kind):
    torch.manual_seed(0)
    loss, data = MAKE[kind](), random_data(256)
    data["action"] = data["observation"][:, :2].tanh()
    data["vla_action", "chunk"] = data["action"][:, None].expand(-1, 4, -1).clone()
    data["action"][:20], data["vla_action", "chunk"][:20] = 8.0, 8.0
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-3)
    for _ in range(300 if kind == "diffusion" else 30):  # which starts from knowing nothing of noise
        loss(data)[loss.loss_key].backward()
        optimizer.step()
        optimizer.zero_grad()
    rating = loss.rating(data, draws=8)
    assert auroc(-rating[:20].numpy(), -rating[20:].numpy()) > 0.9


def test_other_outputs_are_means_that_no_trainer_sums():
    torch.manual_seed(0)
    loss = MAKE["act"]()
    out = loss(random_data(6))
    assert set(out.keys()) == set(loss.out_keys)
    assert [key for key in loss.out_keys if key.startswith("loss")] == ["loss_act"]
    assert out["kl"].shape == out["reconstruction"].shape == ()
    assert loss.rating_module.dims == 8  # 4 steps of 2 dimensions: the loss has one number a sample


def test_dims_can_be_said_and_are_found():
    data = random_data(6)
    loss = RatedLoss(bc_loss(nn.Linear(3, 2)), dims=1.5)
    loss(data)
    assert loss.rating_module.dims == 1.5
    loss = RatedLoss(bc_loss(nn.Linear(3, 2), loss_function=lambda x, y: (x - y).square().sum(-1)))
    loss(data)
    assert loss.rating_module.dims == 2
    summed = loss.rating(data)
    mean = RatedLoss(loss.loss_module)
    mean.loss_module.loss_function = "l2"
    mean(data)
    torch.testing.assert_close(mean.rating(data), summed)  # a sum and a mean over the dimensions


def test_sequences_and_dispatch():
    torch.manual_seed(0)
    data = TensorDict({"observation": torch.randn(4, 5, 3), "action": torch.randn(4, 5, 2)}, [4, 5])
    loss = RatedLoss(bc_loss(nn.Linear(3, 2)))
    loss(data)
    assert loss.rating(data).shape == (4, 5) and loss.rating_module.dims == 2
    data.batch_size = [4]
    loss(data)
    assert loss.rating(data).shape == (4,) and loss.rating_module.dims == 10
    own = RatedLoss(deepcopy(loss.loss_module))
    expected = RatedLoss(deepcopy(loss.loss_module))(data)
    got = own(observation=data["observation"], action=data["action"])
    assert len(got) == len(own.out_keys) and torch.equal(got[0], expected["loss_bc"])


def test_keys_and_masks_are_the_wrapped_losss():
    actor = TensorDictModule(nn.Linear(3, 2), in_keys=["state"], out_keys=["act"])
    loss = RatedLoss(BCLoss(actor, loss_function="l2", reduction="none"))
    loss.set_keys(action="act")
    loss.loss_mask_key = "valid"
    assert loss.loss_module.tensor_keys.action == "act" and loss.loss_module.loss_mask_key == "valid"
    assert set(loss.in_keys) == {"state", "act"}
    data = TensorDict({"state": torch.randn(4, 3), "act": torch.randn(4, 2), "valid": torch.arange(4) > 0}, [4])
    loss(data)
    assert loss.rating(data).isnan().tolist() == [True, False, False, False]
    with pytest.raises(TypeError, match="action"):
        loss.set_keys(action=3)
    loss.set_keys(action="elsewhere")
    with pytest.raises(KeyError, match="no 'elsewhere'.*set_keys"):
        loss(data)


def test_compiled_it_is_the_same():
    torch.manual_seed(0)
    loss, data = MAKE["bc"](), random_data(6)
    twin = deepcopy(loss)
    got = torch.compile(twin, backend="eager")(data)
    for key, value in loss(data).items():
        torch.testing.assert_close(got[key], value)


def test_what_does_not_fit_is_named():
    net = nn.Linear(3, 2)
    for wrong in ("mean", "sum"):
        with pytest.raises(ValueError, match=f"BCLoss has reduction='{wrong}'.*reduction='none'"):
            RatedLoss(bc_loss(net, reduction=wrong))
    with pytest.raises(TypeError, match="loss of TorchRL, got Linear"):
        RatedLoss(net)
    with pytest.raises(ValueError, match="loss_act.*loss_key="):
        RatedLoss(act_loss())
    for rated in (RatedLoss(bc_loss(net)), TsallisBCLoss(make_policy(3, 2), reduction="none")):
        with pytest.raises(ValueError, match="rates its samples already"):
            RatedLoss(rated)
    with pytest.raises(TypeError, match="takes a PeakRating"):
        RatedLoss(bc_loss(net), rating=TsallisRating())
    for name, wrong in (("rate", 0), ("rate", 2), ("dims", 0), ("dims", math.nan), ("reduction", "max")):
        with pytest.raises(ValueError, match=name):
            RatedLoss(bc_loss(net), **{name: wrong})
    with pytest.raises(ValueError, match="draws"):
        RatedLoss(bc_loss(net)).rating(random_data(3), draws=-1)
    with pytest.raises(KeyError, match="no 'loss_other'.*loss_key"):
        RatedLoss(bc_loss(net), loss_key="loss_other")(random_data(3))
    with pytest.raises(NotImplementedError, match="distribution"):
        RatedLoss(bc_loss(net)).surprise(random_data(3))


def test_data_that_does_not_fit_is_named():
    loss, data = MAKE["bc"](), random_data(6)
    with pytest.raises(KeyError, match="the batch has no .*action"):
        loss(data.exclude("action"))
    with pytest.raises(TypeError, match="float64.*float32"):
        loss(data.double())
    with pytest.raises(ValueError, match="no samples"):
        loss(data[:0])
    before = data.clone()
    loss(data)
    assert (data == before).all() and set(data.keys(True)) == set(before.keys(True))
    chunks = RatedLoss(bc_loss(nn.Linear(3, 2)))
    chunks.set_keys(pad_mask="pad")
    with pytest.raises(ValueError, match="pad_mask.*loss_mask_key"):
        chunks(data)
    flat = RatedLoss(bc_loss(nn.Linear(3, 2), loss_function=lambda x, y: (x - y).square().flatten()))
    with pytest.raises(ValueError, match=r"'loss_bc' has shape \[12\], the batch \[6\]"):
        flat(data)
    likelihood = RatedLoss(BCLoss(make_policy(3, 2), reduction="none"))
    data["action"] = torch.zeros(6, 2)
    likelihood.loss_module.loss_function = lambda x, y: (x - y).square().mean(-1) - 100
    with pytest.raises(ValueError, match="negative values.*TsallisBCLoss"):
        likelihood(data)


def test_a_second_term_with_a_gradient_is_not_lost_in_silence():
    class TwoTerms(BCLoss):
        def forward(self, tensordict):
            out = super().forward(tensordict)
            out["loss_extra"] = out["loss_bc"].sum()
            return out

    actor = TensorDictModule(nn.Linear(3, 2), in_keys=["observation"], out_keys=["action"])
    loss = RatedLoss(TwoTerms(actor, loss_function="l2", reduction="none"))
    with pytest.raises(ValueError, match="loss_extra.*gradient"):
        loss(random_data(4))


def test_processes_share_the_scale_and_the_rating(monkeypatch):
    torch.manual_seed(0)
    data, net = random_data(8), nn.Linear(3, 2)
    alone = RatedLoss(bc_loss(net))
    shared = RatedLoss(bc_loss(deepcopy(net)))
    of = shared.batch_of

    def doubled(mask, sync=True):  # two processes with the same samples
        batch = of(mask, sync)
        batch.total, batch.num_processes = lambda *values: [2 * value for value in values], 2
        return batch

    monkeypatch.setattr(shared, "batch_of", doubled)
    one, two = alone(data), shared(data)
    for key, value in one.items():
        torch.testing.assert_close(two[key], value * (2 if key == "ess" else 1))
    torch.testing.assert_close(shared.scale.value, alone.scale.value)
