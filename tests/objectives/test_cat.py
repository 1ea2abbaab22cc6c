from __future__ import annotations

import io
import math
import pickle

import pytest
import torch
from tensordict import TensorDict, TensorDictParams
from tensordict.nn import TensorDictModule
from torchrl.objectives import SoftUpdate
from torchrl.objectives.common import LossModule

from torchrl_tsallis.modules import make_policy
from torchrl_tsallis.objectives.bc import TsallisBCLoss
from torchrl_tsallis.objectives.cat import CATSoftUpdate


class _Loss(LossModule):
    net: TensorDictModule
    net_params: TensorDictParams
    target_net_params: TensorDictParams

    def __init__(self, nets, target=True):
        super().__init__()
        many = isinstance(nets, list)
        self.convert_to_functional(nets, "net", expand_dim=len(nets) if many else None, create_target_params=target)

    def _forward_value_estimator_keys(self, **kwargs):
        pass

    def forward(self, tensordict):
        return TensorDict({}, [])


def _net(seed=0):
    torch.manual_seed(seed)
    layers = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.Linear(4, 2))
    return TensorDictModule(layers, in_keys=["x"], out_keys=["y"]).double()


def _leaves(params):
    return [params.get(k).data for k in sorted(params.keys(True, True), key=str)]


def _move(loss, seed, index=None):
    """Moves all parameters, the same for member `index` of an ensemble as for a loss of its own."""
    for i, p in enumerate(_leaves(loss.net_params)):
        gen = torch.Generator().manual_seed(100 * seed + i)
        noise = torch.randn((2, *p.shape[1:]) if index is None else (2, *p.shape), generator=gen, dtype=p.dtype)
        p.add_(0.01 * (noise if index is None else noise[index]))


def test_is_soft_update_in_the_limit():
    first, second = _Loss(_net()), _Loss(_net())
    cat, soft = CATSoftUpdate(first, tau=0.1, strength=0.0, k=math.inf), SoftUpdate(second, tau=0.1)
    for i in range(20):
        _move(first, i, 0), _move(second, i, 0)
        cat.step(), soft.step()
    for a, b in zip(_leaves(first.target_net_params), _leaves(second.target_net_params), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-14)
    for a, b in zip(_leaves(first.net_params), _leaves(second.net_params), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("strength", [0.0, 0.5])
def test_single_step_by_hand(strength):
    loss = _Loss(TensorDictModule(torch.nn.Linear(1, 1, bias=False), in_keys=["x"], out_keys=["y"]).double())
    updater = CATSoftUpdate(loss, tau=0.4, strength=strength, eps=0.5, init_scale="eps")
    theta, target = _leaves(loss.net_params)[0], _leaves(loss.target_net_params)[0]
    target.fill_(0.0), theta.fill_(1.0)
    updater.step()
    # d2 = 1, v = 0.25, D = 4, nu = 1.5: w / w_max = 1.5 / 5.5, floor = max(0.25, 0) = 0.25
    t = 0.4 * 1.5 / 5.5
    assert target.item() == pytest.approx(t, rel=1e-12)
    assert theta.item() == pytest.approx(1 - strength * (0.4 - t), rel=1e-12)
    state = updater.state_dict()["cat"]["target_net_params"]
    w, largest = 2.5 / 5.5, 2.5 / 1.5
    w_nu, bound = w - math.log(w), 126 * math.log(2)  # 2^-126: the smallest normal float32
    star = (3.5 / 2.5 + 1.5) / w_nu * (1 - 1 / 1.5) + 1.5
    assert largest - math.log(largest) < bound
    assert next(iter(state["nu"].values())).item() == pytest.approx(1.5 + 0.4 * w_nu / bound * (star - 1.5), rel=1e-12)
    assert next(iter(state["scale"].values())).item() == pytest.approx(0.25 + t * (1.25 - 0.25), rel=1e-12)


def test_members_are_independent():
    ensemble = _Loss([_net(0), _net(1)])
    solo = [_Loss(_net(0)), _Loss(_net(1))]
    together, alone = CATSoftUpdate(ensemble), [CATSoftUpdate(x) for x in solo]
    for step in range(20):
        _move(ensemble, step)
        together.step()
        for i in range(2):
            _move(solo[i], step, i)
            alone[i].step()
    for i in range(2):
        for name in ("net_params", "target_net_params"):
            for a, b in zip(_leaves(getattr(ensemble, name)), _leaves(getattr(solo[i], name)), strict=True):
                torch.testing.assert_close(a[i], b, rtol=1e-10, atol=1e-14)


def test_state_dict_round_trip_is_exact():
    loss = _Loss(_net())
    updater = CATSoftUpdate(loss)
    for i in range(5):
        _move(loss, i, 0)
        updater.step()
    file = io.BytesIO()
    torch.save({"loss": loss.state_dict(), "updater": updater.state_dict()}, file)
    file.seek(0)
    saved = torch.load(file, weights_only=True)
    other = _Loss(_net(3))
    resumed = CATSoftUpdate(other)
    other.load_state_dict(saved["loss"])
    resumed.load_state_dict(saved["updater"])
    for i in range(5, 10):
        _move(loss, i, 0), _move(other, i, 0)
        updater.step(), resumed.step()
    for a, b in zip(_leaves(loss.target_net_params), _leaves(other.target_net_params), strict=True):
        assert torch.equal(a, b)
    state = updater.state_dict()
    del state["cat"]["target_net_params"]["nu"]["module.0.bias"]
    with pytest.raises(KeyError, match=r"'nu' of 'module.0.bias'"):
        resumed.load_state_dict(state)
    state = updater.state_dict()
    state["cat"]["target_net_params"]["scale"]["module.0.bias"] = torch.zeros(7)
    with pytest.raises(ValueError, match=r"module.0.bias.*\(7,\).*\(4,\)"):
        resumed.load_state_dict(state)


def test_pickled_with_its_loss_it_follows():
    loss = _Loss(_net())
    updater = CATSoftUpdate(loss)
    _move(loss, 0, 0)
    updater.step()
    copied, follower = pickle.loads(pickle.dumps((loss, updater)))
    for a_loss, an_updater in ((loss, updater), (copied, follower)):
        _move(a_loss, 1, 0)
        an_updater.step()
    for name in ("net_params", "target_net_params"):
        for a, b in zip(_leaves(getattr(loss, name)), _leaves(getattr(copied, name)), strict=True):
            assert torch.equal(a, b)


def test_follows_the_data_type():
    loss = _Loss(_net().float())
    updater = CATSoftUpdate(loss)
    loss.double()
    _move(loss, 0, 0)
    updater.step()
    assert updater.state_dict()["cat"]["target_net_params"]["scale"]["module.0.bias"].dtype == torch.float64


def test_first_scale_waits_for_a_difference():
    loss = _Loss(_net())
    updater = CATSoftUpdate(loss, strength=0.0)
    updater.step()
    _move(loss, 0, 0)
    before = [x.clone() for x in _leaves(loss.target_net_params)]
    updater.step()
    # The first step had D = 0 and nu = 1 + eps, so that w = w_max; it moved nu a little, by the equations.
    nu = 1 + 1e-5
    w = (nu + 1) / nu
    w_nu = w - math.log(w)
    star = ((nu + 2) / (nu + 1) + nu) / w_nu * (1 - 1 / nu) + 1 + 1e-5
    nu += 0.1 * w_nu / (126 * math.log(2)) * (star - nu)
    # Then D = 1: the share is nu / (nu + 1).
    share = nu / (nu + 1)
    rows = zip(before, _leaves(loss.target_net_params), _leaves(loss.net_params), strict=True)
    for old, new, theta in rows:
        torch.testing.assert_close(new, old + 0.1 * share * (theta - old), rtol=1e-10, atol=1e-14)


def test_without_target_nothing_happens():
    loss = _Loss(_net(), target=False)
    before = [x.clone() for x in _leaves(loss.net_params)]
    updater = CATSoftUpdate(loss)
    updater.step()
    updater.load_state_dict(updater.state_dict())
    for a, b in zip(before, _leaves(loss.net_params), strict=True):
        assert torch.equal(a, b)


class _Twice(torch.nn.Module):
    """A layer under as many names as asked for; the same function whatever the number."""

    def __init__(self, names):
        super().__init__()
        self.a = torch.nn.Linear(3, 3)
        for name in names:
            setattr(self, name, self.a)
        self.z = torch.nn.Linear(3, 2)

    def forward(self, x):
        return self.z(getattr(self, "m", self.a)(self.a(x)))


@pytest.mark.parametrize("names", [["m"], ["Z"], ["b", "m", "n"]], ids=str)
def test_a_parameter_of_several_names_is_updated_once(names):
    losses = []
    for more in ([], names):
        torch.manual_seed(0)
        losses.append(_Loss(TensorDictModule(_Twice(more), in_keys=["x"], out_keys=["y"]).double()))
    updaters = [CATSoftUpdate(loss) for loss in losses]
    for step in range(10):
        for loss, updater in zip(losses, updaters, strict=True):
            generator = torch.Generator().manual_seed(step)
            for p in loss.parameters():
                p.data.add_(0.01 * torch.randn(p.shape, generator=generator, dtype=p.dtype))
            updater.step()
    one, several = losses
    for params in ("net_params", "target_net_params"):
        for name in ("a", *names):
            for leaf in ("weight", "bias"):
                expected = getattr(one, params).get(("module", "a", leaf))
                assert torch.equal(getattr(several, params).get(("module", name, leaf)), expected)
        for leaf in ("weight", "bias"):
            keys = ("module", "z", leaf)
            assert torch.equal(getattr(several, params).get(keys), getattr(one, params).get(keys))
    resumed = CATSoftUpdate(several)
    resumed.load_state_dict(updaters[1].state_dict())


def test_members_that_the_loss_leaves_out_are_not_pulled():
    loss = _Loss([_net(0), _net(1), _net(2)])
    loss.target_members = torch.tensor([True, False, True])
    updater = CATSoftUpdate(loss)
    for p in loss.parameters():
        p.data.add_(0.01 * torch.randn_like(p))
    before = [x.clone() for x in _leaves(loss.net_params)]
    updater.step()
    moved = [not torch.equal(x[k], y[k]) for k in range(3) for x, y in [(_leaves(loss.net_params)[0], before[0])]]
    assert moved == [True, False, True]


NUMBERS = ("tau", "strength", "eps", "k")


@pytest.mark.parametrize("value", [None, True, "1", math.nan, -math.inf, -1, [], [0.1, 0.2], 1j], ids=str)
@pytest.mark.parametrize("name", NUMBERS)
def test_every_number_is_checked(name, value):
    with pytest.raises((TypeError, ValueError), match=f"^{name} must be"):
        CATSoftUpdate(_Loss(_net()), **{name: value})


@pytest.mark.parametrize("name", NUMBERS)
def test_infinity_is_for_k_alone(name):
    if name == "k":
        CATSoftUpdate(_Loss(_net()), k=math.inf)
        return
    with pytest.raises(ValueError, match=f"^{name} must be"):
        CATSoftUpdate(_Loss(_net()), **{name: math.inf})


@pytest.mark.parametrize("loss", [None, torch.nn.Linear(2, 2), "loss", []], ids=lambda x: type(x).__name__)
def test_what_is_no_loss_is_named(loss):
    with pytest.raises(TypeError, match="^loss_module must be a loss"):
        CATSoftUpdate(loss)


@pytest.mark.parametrize("value", [None, "first ", 1, True])
def test_a_start_of_the_scale_that_does_not_exist_is_named(value):
    with pytest.raises(ValueError, match="init_scale must be 'first' or 'eps'"):
        CATSoftUpdate(_Loss(_net()), init_scale=value)


@pytest.mark.parametrize(
    "options", [{"tau": 2.0}, {"strength": -1.0}, {"eps": 0.0}, {"k": 0.0}, {"init_scale": "x"}], ids=str
)
def test_wrong_arguments(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        CATSoftUpdate(_Loss(_net()), **options)


def test_a_target_that_follows_at_once_keeps_a_scale():
    torch.manual_seed(1)
    loss = TsallisBCLoss([make_policy(3, 2, hidden=(9,)) for _ in range(3)])
    updater = CATSoftUpdate(loss, tau=1.0, k=math.inf, strength=0.0)
    for size in (0.01, 0.01, 0.01, 0.3, 1e-7, 0.01, 1e-7, 1.0, 1e-7):
        with torch.no_grad():
            for p in loss.parameters():
                p.add_(size * torch.randn_like(p))
        updater.step()
        scales = updater.state_dict()["cat"]["target_actor_network_params"]["scale"]
        assert all((x >= 1e-10 * (1 - 1e-6)).all() for x in scales.values())
