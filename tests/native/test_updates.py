"""AdaTerm and CAT-soft by the native kernels, against the same steps in torch."""

from __future__ import annotations

import copy
import math

import pytest
import torch

from torchrl_tsallis import AdaTerm, CATSoftUpdate, TsallisBCLoss, native
from torchrl_tsallis.modules import make_policy
from torchrl_tsallis.native import updates

SHAPES = [(3, 5), (1,), (40, 17), (2, 16), (257,)]


def _trained(flag, options, grads, members=None):
    """Parameters and state after a step with each of the gradients."""
    torch.manual_seed(0)
    first = () if members is None else (members,)
    params = [torch.nn.Parameter(torch.randn(*first, *shape)) for shape in SHAPES]
    optimizer = AdaTerm(params, batch_dims=len(first), **options)
    with native.used(flag):
        for row in grads:
            for p, g in zip(params, row, strict=True):
                p.grad = g.clone()
            optimizer.step()
    return params, [optimizer.state[p] for p in params]


def _gradients(steps, members=None, scale=1.0):
    first = () if members is None else (members,)
    return [[scale * torch.randn(*first, *shape) for shape in SHAPES] for _ in range(steps)]


def _same(first, second, rtol=2e-5, atol=1e-6):
    for a, b in zip(first[0], second[0], strict=True):
        torch.testing.assert_close(a, b, rtol=rtol, atol=atol)
    for a, b in zip(first[1], second[1], strict=True):
        assert a.keys() == b.keys()
        for name in a:
            torch.testing.assert_close(a[name], b[name], rtol=1e-4, atol=1e-7 if name != "nu" else 1e-5)


OPTIONS = [
    {}, {"weight_decay": 0.1}, {"k": math.inf}, {"ini_dof": 5.0}, {"betas": (0.9, 0.99, 0.5)},
    {"betas": (0.0, 0.0, 0.0)}, {"betas": (0.9, 0.9, 1.0)}, {"eps": 0.1},
    {"lr": torch.tensor(0.01)}, {"k": 3.0, "lr": 0.0},
]  # fmt: skip


@pytest.mark.parametrize("options", OPTIONS, ids=str)
@pytest.mark.parametrize("members", [None, 3])
def test_adaterm_is_that_of_torch(kernels, monkeypatch, options, members):
    called, own = [], updates.adaterm
    monkeypatch.setattr(updates, "adaterm", lambda *given: called.append(1) or own(*given))
    grads = _gradients(20, members)
    grads[7] = [1e4 * g for g in grads[7]]  # an outlier
    _same(_trained(True, options, grads, members), _trained(False, options, grads, members))
    assert len(called) == 20


def test_the_first_step_of_adaterm_by_hand(kernels):
    p = torch.nn.Parameter(torch.tensor([1.0, -1.0]))
    optimizer = AdaTerm([p], lr=0.5, k=math.inf, eps=1.0, betas=(0.5, 0.5, 0.5))
    p.grad = torch.tensor([2.0, 0.0])
    optimizer.step()
    # m = (1, 0), s = (2, 0), floor 1; c1 = c2 = 0.5: 0.5 * 1 / 0.5 / sqrt(3 / 0.5)
    assert p.tolist() == pytest.approx([1 - 1 / math.sqrt(6.0), -1.0], rel=1e-6)
    assert optimizer.state[p]["exp_avg_sq"].tolist() == pytest.approx([2.0, 0.0])
    assert optimizer.state[p]["step"].item() == 1


@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1e15, 1e25, 3e38])
def test_extreme_gradients_give_what_torch_gives(kernels, scale):
    grads = _gradients(5, scale=scale / 3)
    first, second = _trained(True, {}, grads), _trained(False, {}, grads)
    assert all(p.isfinite().all() for p in first[0])
    for a, b in zip(first[0], second[0], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("members", [None, 3])
def test_a_gradient_that_is_not_finite_leaves_its_tensor_or_member_as_it_is(kernels, bad, members):
    grads = _gradients(3, members)
    grads[1][2].view(-1)[-1] = bad
    first, second = _trained(True, {}, grads, members), _trained(False, {}, grads, members)
    _same(first, second)
    skipped = first[1][2]["skipped"]
    assert skipped.sum() == 1
    assert first[1][2]["step"].sum() == 3 * (members or 1) - 1
    before = _trained(True, {}, grads[:1], members)[0][2]
    after = _trained(True, {}, grads[:2], members)[0][2]
    assert torch.equal(before[-1] if members else before, after[-1] if members else after)


@pytest.mark.parametrize(
    "options", [{"amsgrad": 0.9}, {"uncentered": True}, {"adaptive_bias": True}, {"skip_nonfinite": False}], ids=str
)
def test_what_the_kernel_does_not_know_is_left_to_torch(kernels, options):
    grads = _gradients(3)
    for a, b in zip(_trained(True, options, grads)[0], _trained(False, options, grads)[0], strict=True):
        assert torch.equal(a, b)


def test_float64_and_parameters_that_are_not_in_a_row_are_left_to_torch(kernels):
    for p in (torch.randn(4, 3, dtype=torch.float64), torch.randn(4, 3).t()):
        found = []
        for flag in (True, False):
            parameter = torch.nn.Parameter(p.clone(memory_format=torch.preserve_format))
            optimizer = AdaTerm([parameter])
            with native.used(flag):
                parameter.grad = torch.ones_like(parameter)
                optimizer.step()
            found.append(parameter)
        assert torch.equal(*found)


def test_a_state_goes_from_the_kernel_to_torch_and_back(kernels):
    grads = _gradients(6)
    whole = _trained(True, {}, grads)
    params, _ = _trained(True, {}, grads[:3])
    optimizer = AdaTerm(params)
    torch.manual_seed(0)
    other = AdaTerm([torch.nn.Parameter(torch.randn(shape)) for shape in SHAPES])
    with native.used(True):
        for row in grads[:3]:
            for p, g in zip(other.param_groups[0]["params"], row, strict=True):
                p.grad = g
            other.step()
    optimizer.load_state_dict(copy.deepcopy(other.state_dict()))
    for number, row in enumerate(grads[3:]):
        for p, g in zip(params, row, strict=True):
            p.grad = g
        with native.used(number != 1):
            optimizer.step()
    _same((params, [optimizer.state[p] for p in params]), whole)


def _followed(flag, options, members=None, steps=12, **settings):
    """Parameters, targets and state after steps in which the parameters move."""
    torch.manual_seed(1)
    policies = [make_policy(3, 2, hidden=(9,)) for _ in range(members or 1)]
    loss = TsallisBCLoss(policies if members else policies[0], **settings)
    updater = CATSoftUpdate(loss, **options)
    params = list(loss.parameters())
    with native.used(flag):
        for number in range(steps):
            with torch.no_grad():
                for p in params:
                    p.add_((0.3 if number == 5 else 0.01) * torch.randn_like(p))
            updater.step()
    target = [p.clone() for p in loss.target_actor_network_params.values(True, True)]
    state = updater.state_dict()["cat"]["target_actor_network_params"]
    return [*params, *target, *(x for name in sorted(state) for _, x in sorted(state[name].items()))]


@pytest.mark.parametrize(
    "options",
    [{}, {"tau": 0.5}, {"strength": 0.0}, {"strength": 0.3}, {"k": math.inf}, {"k": 4.0, "eps": 1e-2},
     {"init_scale": "eps"}, {"tau": 0.0}, {"tau": 1.0, "k": math.inf, "strength": 0.0}],
    ids=str,
)  # fmt: skip
@pytest.mark.parametrize("members", [None, 3])
def test_cat_soft_is_that_of_torch(kernels, options, members):
    for a, b in zip(_followed(True, options, members), _followed(False, options, members), strict=True):
        torch.testing.assert_close(a, b, rtol=2e-4, atol=1e-6)
        assert not a.isnan().any()


def test_members_that_have_no_target_are_not_pulled(kernels, monkeypatch):
    called, own = [], updates.cat
    monkeypatch.setattr(updates, "cat", lambda *given: called.append(given[6]) or own(*given))
    settings = {"gamma_mix": ["adaptive", 0.0, 0.5]}
    for a, b in zip(_followed(True, {}, 3, **settings), _followed(False, {}, 3, **settings), strict=True):
        torch.testing.assert_close(a, b, rtol=2e-4, atol=1e-6)
    assert len(called) >= 10
    assert called[0].tolist() == [False, True, False]


def test_one_step_of_cat_soft_by_hand(kernels):
    source, target = torch.tensor([1.0, 0.0]), torch.zeros(2)
    state = {"scale": torch.tensor([0.5, 0.5]), "nu": torch.tensor([1.0])}
    layout, distance = updates.Layout([2], [1]), torch.empty(1)
    updates.cat_distance(kernels, layout, [source], [target], state["scale"], distance)
    assert distance.item() == 1.0  # (2 + 0) / 2
    updates.cat(kernels, layout, [source], [target], state, distance, None, (0.5, 1.0, 0.1, 1.0))
    # w / w_max = (2 / 2) / (2 / 1) = 1 / 2: t = 0.25; scale: 0.5 + 0.25 (1 + 0.5 - 0.5), 0.5 + 0.25 (0 + 0.01 - 0.5)
    assert target.tolist() == pytest.approx([0.25, 0.0])
    assert source.tolist() == pytest.approx([1 - (0.5 - 0.25), 0.0])
    assert state["scale"].tolist() == pytest.approx([0.75, 0.3775])


def test_a_replaced_policy_is_still_noticed(kernels):
    torch.manual_seed(0)
    loss = TsallisBCLoss(make_policy(3, 2, hidden=(20,)))
    updater = CATSoftUpdate(loss)
    for _ in range(3):
        with torch.no_grad():
            for p in loss.parameters():
                p.add_(0.001 * torch.randn_like(p))
        updater.step()
    with torch.no_grad():
        for p, new in zip(loss.parameters(), make_policy(3, 2, hidden=(20,)).parameters(), strict=True):
            p.copy_(new)
    wanted = [p.clone() for p in loss.parameters()]
    updater.step()
    assert all(torch.equal(p, w) for p, w in zip(loss.parameters(), wanted, strict=True))
