"""The paper's network as one step of autograd: the numbers of its modules, to the same bit."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torchrl_tsallis import TsallisBCLoss, native
from torchrl_tsallis.modules import Linear, Squish, make_policy
from torchrl_tsallis.modules.fast import _Layers, network_of, plain_layers
from torchrl_tsallis.objectives.actor import get_dist, get_dist_with


@pytest.fixture(autouse=True)
def without_kernels():
    with native.used(False):
        yield


def _params(sizes, members=None, dtype=torch.float64):
    first, params = () if members is None else (members,), []
    for index, (n_in, n_out) in enumerate(zip(sizes[:-1], sizes[1:], strict=True)):
        params += [torch.randn(*first, n_out, n_in, dtype=dtype), torch.randn(*first, n_out, dtype=dtype)]
        params += [torch.rand(*first, n_out, dtype=dtype) + 0.5] if index < len(sizes) - 2 else []
    return [p.requires_grad_() for p in params]


def test_one_hidden_unit_by_hand():
    # z = 3 * 2 + 1 = 7; unit = 7 / sqrt(49) = 1; y = 1.5; squish = 1.2; out = 1.2 * [2, -1] + [0.5, 1]
    params = [torch.tensor([[3.0]]), torch.ones(1), torch.tensor([1.5]), torch.tensor([[2.0], [-1.0]]), None]
    params[-1] = torch.tensor([0.5, 1.0])
    params = [p.requires_grad_() for p in params]
    out = _Layers.apply((0.0,), torch.tensor([[2.0]]), *params)
    torch.testing.assert_close(out, torch.tensor([[2.9, -0.2]]))
    out.sum().backward()
    # by squish 2 - 1 = 1; s = 1.5 / 2.5 = 0.6, slope (1 + 1.2 - 0.216) / 2 = 0.992; by the norm's weight 0.992
    assert params[2].grad.item() == pytest.approx(0.992, rel=1e-6)
    torch.testing.assert_close(params[3].grad, torch.tensor([[1.2], [1.2]]))
    assert params[0].grad.abs().item() == pytest.approx(0.0, abs=1e-6)  # the norm of one unit is its sign


@pytest.mark.parametrize("members", [None, 3])
def test_gradients_of_both_orders_are_those_of_finite_differences(members):
    params = _params((2, 3, 4, 2), members)
    x = torch.randn(*(() if members is None else (members,)), 4, 2, dtype=torch.float64, requires_grad=True)

    def layers(*inputs):
        return _Layers.apply((1e-3, 1e-3), *inputs)

    assert torch.autograd.gradcheck(layers, (x, *params))
    assert torch.autograd.gradgradcheck(layers, (x, *params))
    torch.testing.assert_close(layers(x, *params), plain_layers(x, params, (1e-3, 1e-3)))


@pytest.mark.parametrize("members", [None, 3])
@pytest.mark.parametrize("hidden", [(5,), (100, 100), (8, 3, 8)])
def test_the_modules_give_the_same_to_the_bit(monkeypatch, members, hidden):
    actors = [make_policy(4, 2, hidden=hidden) for _ in range(members or 1)]
    shape = [7] if members is None else [members, 7]
    data = TensorDict({"observation": torch.randn(*shape, 4), "action": torch.randn(*shape, 2)}, shape)
    found = []
    for fast in (True, False):
        if not fast:
            monkeypatch.setattr("torchrl_tsallis.objectives.actor.network_of", lambda *_: None)
        copies = [copy.deepcopy(actor) for actor in actors]
        loss = TsallisBCLoss(copies if members else copies[0], gamma_mix=0.0)
        out = loss(data)
        out["loss_tsallis_bc"].backward()
        found.append([out["loss_tsallis_bc"], *(p.grad for p in loss.parameters())])
    assert len(found[0]) > 5
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def test_a_graph_may_be_walked_twice_and_a_frozen_layer_gets_no_gradient():
    params = _params((2, 3, 2))
    params[0].requires_grad_(False)
    out = _Layers.apply((1e-3,), torch.randn(4, 2, dtype=torch.float64), *params).sum()
    first, second = ([*torch.autograd.grad(out, params[1:], retain_graph=True)] for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    out.backward()
    assert params[0].grad is None
    assert torch.equal(params[1].grad, first[0])


def test_no_gradient_and_a_gradient_give_the_same_numbers():
    params = _params((3, 6, 6, 6, 2), dtype=torch.float32)
    x, eps = torch.randn(9, 3), (1e-7,) * 3
    with torch.no_grad():
        without = _Layers.apply(eps, x, *params)
    assert torch.equal(without, _Layers.apply(eps, x, *params))


class _Louder(Squish):
    def forward(self, x):
        return 2 * super().forward(x)


def _other(change):
    actor = make_policy(3, 2, hidden=(4,))
    network = actor.module[0].module
    change(network)
    return actor, network


CHANGES = {
    "hook": lambda net: net[0].register_forward_hook(lambda *_: None),
    "hook before": lambda net: net[2].register_forward_pre_hook(lambda *_: None),
    "hook of the whole": lambda net: net.register_forward_hook(lambda *_: None),
    "hook of the gradient": lambda net: net[1].register_full_backward_hook(lambda *_: None),
    "own forward": lambda net: setattr(net[2], "forward", lambda x: x),
    "subclass": lambda net: net.__setitem__(2, _Louder()),
    "other activation": lambda net: net.__setitem__(2, nn.Tanh()),
    "no bias": lambda net: net.__setitem__(0, Linear(3, 4, bias=False)),
    "torch's layer": lambda net: net.__setitem__(0, nn.Linear(3, 4)),
    "parametrized": lambda net: nn.utils.parametrizations.weight_norm(net[0]),
    "more": lambda net: net.append(nn.Identity()),
}


@pytest.mark.parametrize("name", CHANGES)
def test_what_is_not_exactly_the_papers_network_is_left_to_its_modules(name):
    actor, network = _other(lambda net: None)
    assert network_of(actor, network) is not None
    CHANGES[name](network)
    assert network_of(actor, network) is None
    actor, network = _other(CHANGES[name])
    assert network_of(actor, network) is None


def test_a_hook_of_a_layer_is_called_in_training():
    actor, called = make_policy(3, 2, hidden=(4,)), []
    loss = TsallisBCLoss(actor, gamma_mix=0.0)
    actor.module[0].module[1].register_forward_hook(lambda *_: called.append(1))
    loss(TensorDict({"observation": torch.zeros(5, 3), "action": torch.zeros(5, 2)}, [5]))
    assert called


def test_a_layer_that_is_used_twice_is_left_to_the_modules():
    actor = make_policy(4, 2, hidden=(4, 4))
    network = actor.module[0].module
    network[3] = network[0]
    assert network_of(actor, network) is None


def test_a_replaced_layer_is_noticed():
    actor = make_policy(3, 2, hidden=(4,))
    network = actor.module[0].module
    assert network_of(actor, network).sizes == (3, 4, 4)
    network[0], network[1] = Linear(3, 6), type(network[1])(6)
    network[3] = Linear(6, 4)
    assert network_of(actor, network).sizes == (3, 6, 4)


def test_function_transforms_get_the_modules():
    actor = make_policy(3, 2, hidden=(4,))
    network, seen = actor.module[0].module, []

    def call(x):
        seen.append(network_of(actor, network))
        return network(x)[0].sum()

    torch.vmap(torch.func.grad(call))(torch.randn(5, 3))
    assert seen == [None]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_other_parameters_of_an_actor_are_those_that_count(dtype):
    actor, other = make_policy(3, 2).to(dtype), make_policy(3, 2).to(dtype)
    data = TensorDict({"observation": torch.randn(2, 5, 3, dtype=dtype)}, [2, 5])
    got = get_dist_with(actor, data, TensorDict.from_module(other))
    expected = get_dist(other, data)
    assert torch.equal(got.mean, expected.mean)
    assert torch.equal(got.base_dist.scale, expected.base_dist.scale)


def test_autocast_and_half_precision_are_left_to_the_modules():
    actor = make_policy(3, 2)
    fast, params = network_of(actor, actor.module[0].module), TensorDict.from_module(actor)
    x = torch.randn(5, 3)
    assert fast(x, params) is not None
    with torch.autocast("cpu", torch.bfloat16):
        assert fast(x, params) is None
    half = TensorDict.from_module(copy.deepcopy(actor).bfloat16())
    assert fast(x.bfloat16(), half) is None
    for odd in (x.double(), x[:, :2], x[0, 0], x[:0]):
        assert fast(odd, params) is None


@pytest.mark.parametrize("large", [1e18, 1e30, float("inf"), float("nan")])
def test_a_row_that_overflows_is_alone(large):
    params = _params((3, 5, 2), dtype=torch.float32)
    x = torch.randn(4, 3)
    expected = _Layers.apply((1e-7,), x, *params)
    x[1] = large
    got = _Layers.apply((1e-7,), x, *params)
    assert torch.equal(got[[0, 2, 3]], expected[[0, 2, 3]])
    assert torch.equal(got.isfinite(), plain_layers(x, params, (1e-7,)).isfinite())
