"""The native network and density, against the plain formulas in float64."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from tensordict import TensorDict

from torchrl_tsallis import TsallisBCLoss, native
from torchrl_tsallis.modules import NormalHead, make_policy
from torchrl_tsallis.modules.fast import network_of, plain_normal
from torchrl_tsallis.native.network import log_density, network
from torchrl_tsallis.objectives.log_prob import _normal_log_prob

SIZES = [(1, 2, 2), (3, 5, 4), (28, 100, 100, 16), (17, 33, 130, 7, 2), (4, 16, 16, 32), (5, 260, 2)]


def _made(sizes, shape, scale=1.0):
    members, params = shape[:-1], []
    for index, (n_in, n_out) in enumerate(zip(sizes[:-1], sizes[1:], strict=True)):
        params += [torch.randn(*members, n_out, n_in) / n_in**0.5, torch.randn(*members, n_out)]
        params += [torch.rand(*members, n_out) + 0.5] if index < len(sizes) - 2 else []
    return scale * torch.randn(*shape, sizes[0]), [p.requires_grad_() for p in params]


def _native(kernels, sizes, x, params, min_scale=0.0):
    eps = (1e-6,) * (len(sizes) - 2)

    def plain(x, params):
        return plain_normal(x, params, head=NormalHead(min_scale), eps=eps)

    return network(kernels, plain, sizes, eps, min_scale, x, params), plain


def _close(got, exact, rtol=2e-4):
    """Equal to the rounding of float32, measured by the largest number of a tensor."""
    torch.testing.assert_close(got.double(), exact, rtol=rtol, atol=5e-6 * max(exact.abs().max().item(), 1e-30))


@pytest.mark.parametrize("shape", [(1,), (63,), (64,), (65,), (1, 200), (3, 70)], ids=str)
@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_outputs_and_gradients_are_those_of_the_plain_formula_in_float64(kernels, sizes, shape):
    x, params = _made(sizes, shape)
    wide = [p.detach().double().requires_grad_() for p in params]
    (loc, scale), plain = _native(kernels, sizes, x, params, min_scale=0.25)
    exact = plain(x.double(), wide)
    _close(loc, exact[0])
    _close(scale, exact[1])
    upstream = [torch.randn_like(loc), torch.randn_like(scale)]
    got = torch.autograd.grad((loc, scale), params, upstream)
    expected = torch.autograd.grad(exact, wide, [g.double() for g in upstream])
    for a, b in zip(got, expected, strict=True):
        _close(a, b, rtol=2e-3)
    with torch.no_grad():  # nothing is kept then
        again = _native(kernels, sizes, x, params, min_scale=0.25)[0]
    assert torch.equal(again[0], loc)
    assert torch.equal(again[1], scale)


def test_one_hidden_unit_by_hand(kernels):
    # z = 3 * 2 + 1 = 7, unit 1, y = 1.5, squish 1.2; mean 1.2 * 2 + 0.5, raw -1.2 + 2.7 = 1.5, scale (1.5 + 2.5) / 2
    params = [torch.tensor(v) for v in ([[3.0]], [1.0], [1.5], [[2.0], [-1.0]], [0.5, 2.7])]
    params = [p.requires_grad_() for p in params]
    loc, scale = network(kernels, None, (1, 1, 2), (0.0,), 0.5, torch.tensor([[2.0]]), params)
    assert loc.item() == pytest.approx(2.9, rel=1e-6)
    assert scale.item() == pytest.approx(2.5, rel=1e-6)
    scale.sum().backward()
    # slope of squareplus (1 + 1.5 / 2.5) / 2 = 0.8; of squish 0.992
    assert params[2].grad.item() == pytest.approx(-0.8 * 0.992, rel=1e-6)
    assert params[3].grad[:, 0].tolist() == pytest.approx([0.0, 0.8 * 1.2], rel=1e-6)
    assert params[4].grad.tolist() == pytest.approx([0.0, 0.8], rel=1e-6)


def test_one_output_alone_has_the_gradient_of_that_one(kernels):
    x, params = _made((3, 5, 4), (9,))
    (loc, scale), plain = _native(kernels, (3, 5, 4), x, params)
    for index, out in enumerate((loc, scale)):
        got = torch.autograd.grad(out.sum(), params, retain_graph=True)
        expected = torch.autograd.grad(plain(x, params)[index].sum(), params)
        for a, b in zip(got, expected, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)


def test_gradients_of_gradients_are_those_of_the_plain_formula(kernels):
    x, params = _made((3, 5, 4), (2, 9))
    out, plain = _native(kernels, (3, 5, 4), x, params)

    def twice(loc, scale):
        first = torch.autograd.grad((loc.square() + scale).sum(), params, create_graph=True)
        return torch.autograd.grad(sum(g.square().sum() for g in first), params)

    for a, b in zip(twice(*out), twice(*plain(x, params)), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e30, -1e30])
def test_a_row_and_a_member_that_overflow_are_alone(kernels, bad):
    sizes = (3, 20, 4)
    x, params = _made(sizes, (3, 70))
    expected = torch.autograd.grad([y.sum() for y in _native(kernels, sizes, x, params)[0]], params)
    before = _native(kernels, sizes, x, params)[0]
    x[1, 5, 0] = bad
    after, _ = _native(kernels, sizes, x, params)
    keep = torch.ones(3, 70, dtype=torch.bool)
    keep[1, 5] = False
    for a, b in zip(after, before, strict=True):
        assert torch.equal(a[keep], b[keep])
    got = torch.autograd.grad([y.sum() for y in after], params)
    for a, b in zip(got, expected, strict=True):
        assert torch.equal(a[[0, 2]], b[[0, 2]])
    assert not math.isnan(bad) or after[0][1, 5].isnan().all()


@pytest.mark.parametrize("raw", [-1e9, -1e4, 0.0, 1e4, 1e9])
def test_the_scale_is_positive_and_its_slope_right_far_out(kernels, raw):
    params = [torch.zeros(1, 1), torch.zeros(1), torch.zeros(1), torch.zeros(2, 1), torch.tensor([0.0, raw])]
    params = [p.requires_grad_() for p in params]
    _, scale = network(kernels, None, (1, 1, 2), (1e-6,), 0.0, torch.zeros(1, 1), params)
    scale.sum().backward()
    wide = torch.tensor(raw, dtype=torch.float64, requires_grad=True)
    exact = (wide + (wide**2 + 4).sqrt()) / 2 if raw >= 0 else 2 / ((wide**2 + 4).sqrt() - wide)
    exact.backward()
    assert scale.item() == pytest.approx(exact.item(), rel=1e-6)
    assert params[4].grad[1].item() == pytest.approx(wide.grad.item() if raw >= 0 else 1 / raw**2, rel=1e-6)


def test_threads_over_members_change_no_bit(kernels):
    x, params = _made((28, 100, 16), (5, 70))
    found = []
    before = torch.get_num_threads()
    try:
        for threads in (1, 2, 4):
            torch.set_num_threads(threads)
            out = _native(kernels, (28, 100, 16), x, params)[0]
            found.append([*out, *torch.autograd.grad([y.sum() for y in out], params)])
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for other in found[1:] for a, b in zip(found[0], other, strict=True))


def test_a_member_has_what_it_has_alone(kernels):
    x, params = _made((3, 20, 4), (3, 70))
    together, _ = _native(kernels, (3, 20, 4), x, params)
    alone, _ = _native(kernels, (3, 20, 4), x[1], [p[1] for p in params])
    assert torch.equal(together[0][1], alone[0])
    assert torch.equal(together[1][1], alone[1])


def test_the_log_density_and_its_gradient_by_hand(kernels):
    loc = torch.tensor([[1.0, 0.0], [0.0, 0.0]], requires_grad=True)
    scale = torch.tensor([[2.0, 0.5], [1.0, 1.0]], requires_grad=True)
    out = log_density(kernels, None, loc, scale, torch.tensor([[3.0, 0.5], [0.0, 0.0]]))
    # z = (1, 1): -1 - ln 2 - ln 0.5 - ln 2 pi
    assert out.tolist() == pytest.approx([-1 - math.log(2 * math.pi), -math.log(2 * math.pi)], rel=1e-6)
    out.sum().backward()
    assert loc.grad.tolist() == [[0.5, 2.0], [0.0, 0.0]]
    assert scale.grad.tolist() == [[0.0, 0.0], [-1.0, -1.0]]


@pytest.mark.parametrize("dims", [1, 5, 6, 7, 16, 40])
@pytest.mark.parametrize("spread", [1e-19, 1e-4, 1.0, 1e6])
def test_the_log_density_is_that_of_float64(kernels, dims, spread):
    scale = spread * (torch.rand(9, 4, dims) + 0.1)
    loc = scale * torch.randn(9, 4, dims)
    given = [loc, scale, loc + 3 * scale * torch.randn_like(loc)]
    found = []
    for function, dtype in (
        (lambda *x: log_density(kernels, None, *x), torch.float32),
        (_normal_log_prob, torch.double),
    ):
        inputs = [x.to(dtype).requires_grad_() for x in given[:2]]
        out = function(*inputs, given[2].to(dtype))
        found.append([out, *torch.autograd.grad(out.sum(), inputs)])
    for got, exact in zip(*found, strict=True):
        torch.testing.assert_close(got.double(), exact, rtol=1e-4, atol=1e-6 * exact.abs().max().item())


@pytest.mark.parametrize("far", [1e10, -1e30, math.inf, -math.inf])
def test_actions_out_of_reach_have_density_0_and_no_gradient(kernels, far):
    action = torch.zeros(3, 2)
    action[1, 1] = far
    loc, scale = torch.full((3, 2), 0.5, requires_grad=True), torch.ones(3, 2, requires_grad=True)
    out = log_density(kernels, None, loc, scale, action)
    assert out.isneginf().tolist() == [False, True, False]
    (out * torch.tensor([1.0, 0.0, 1.0])).sum().nan_to_num(0.0).backward()
    assert loc.grad[1].tolist() == scale.grad[1].tolist() == [0.0, 0.0]
    assert loc.grad[[0, 2]].isfinite().all()


def test_an_action_that_is_no_number_has_no_density(kernels):
    action = torch.tensor([[math.nan, 0.0], [0.0, 0.0]])
    assert log_density(kernels, None, torch.zeros(2, 2), torch.ones(2, 2), action).isnan().tolist() == [True, False]


def test_the_second_derivative_of_the_log_density_is_torchs(kernels):
    loc, scale, action = torch.randn(4, 3), torch.rand(4, 3) + 0.5, torch.randn(4, 3)
    found = []
    for function in (lambda *x: log_density(kernels, _normal_log_prob, *x), _normal_log_prob):
        inputs = [x.clone().requires_grad_() for x in (loc, scale)]
        first = torch.autograd.grad(function(*inputs, action).sum(), inputs, create_graph=True)
        found.append(torch.autograd.grad(sum(g.square().sum() for g in first), inputs))
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("members", [None, 3])
def test_the_loss_uses_them_and_gives_the_same(kernels, monkeypatch, members):
    actors = [make_policy(4, 2, hidden=(20, 20)) for _ in range(members or 1)]
    shape = [9] if members is None else [members, 9]
    data = TensorDict({"observation": torch.randn(*shape, 4), "action": torch.randn(*shape, 2)}, shape)
    found, called = [], []
    own = native.network.network
    monkeypatch.setattr("torchrl_tsallis.modules.fast.native_network", lambda *given: called.append(1) or own(*given))
    for flag in (True, False):
        with native.used(flag):
            copies = [copy.deepcopy(actor) for actor in actors]
            loss = TsallisBCLoss(copies if members else copies[0], gamma_mix=0.0)
            out = loss(data)
            out["loss_tsallis_bc"].backward()
            found.append([out["loss_tsallis_bc"], *(p.grad for p in loss.parameters())])
        assert len(called) == 1
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)


def test_parameters_that_are_not_in_a_row_are_taken_in_their_order(kernels):
    actor = make_policy(4, 2, hidden=(20,))
    data = TensorDict({"observation": torch.randn(9, 4)}, [9])
    params = TensorDict.from_module(actor)
    fast = network_of(actor, actor.module[0].module)
    turned = params.apply(lambda p: p.detach().t().contiguous().t() if p.ndim == 2 else p.detach())
    for a, b in zip(fast(data["observation"], turned), fast(data["observation"], params), strict=True):
        assert torch.equal(a, b.detach())


def test_float64_and_observations_with_a_gradient_are_left_to_torch(kernels, monkeypatch):
    monkeypatch.setattr("torchrl_tsallis.modules.fast.native_network", None)  # a call would be an error
    actor = make_policy(4, 2, hidden=(20,))
    fast, x = network_of(actor, actor.module[0].module), torch.randn(5, 4, requires_grad=True)
    fast(x, TensorDict.from_module(actor))[0].sum().backward()
    assert x.grad.abs().sum() > 0
    assert fast(x.detach().double(), TensorDict.from_module(copy.deepcopy(actor).double())) is not None
