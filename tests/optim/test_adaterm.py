from __future__ import annotations

import copy
import io
import math

import pytest
import torch

from torchrl_tsallis.optim import AdaTerm


class Reference:
    """One tensor, by the equations, in plain Python order."""

    def __init__(self, x, lr=1e-3, betas=(0.9, 0.9, 0.9), eps=1e-5, k=1.0, weight_decay=0.0, amsgrad=0.0,
                 uncentered=False, adaptive_bias=False, ini_dof=None):  # fmt: skip
        self.x, self.lr, self.betas, self.eps, self.k = x.clone(), lr, betas, eps, k
        self.wd, self.ams, self.unc, self.ab = weight_decay, amsgrad, uncentered, adaptive_bias
        self.m, self.s = torch.zeros_like(x), torch.zeros_like(x)
        self.e, self.top = torch.full_like(x, eps**2), torch.zeros_like(x)
        self.nu = k + eps if ini_dof is None or ini_dof == k else ini_dof
        self.t, self.p1, self.p2 = 0, 1.0, 1.0

    def step(self, g):
        b1, b2, b3 = self.betas
        g = g + self.wd * self.x
        self.t += 1
        d2, v = (g - self.m) ** 2, self.s + self.e
        dist = (d2 / v).mean().item()
        nu, k, eps = self.nu, self.k, self.eps
        if math.isinf(k):
            t1, t2, de = 1 - b1, 1 - b2, torch.full_like(v, eps**2)
        else:
            w, wm = (nu + 1) / (nu + dist), (nu + 1) / nu
            t1, t2 = (1 - b1) * w / wm, (1 - b2) * w / wm
            de = ((d2 - dist * v) / nu).clamp(min=eps**2)
            wn = w - math.log(w)
            tn = (1 - b3) * wn / max(wm - math.log(wm), 126 * math.log(2))  # 2^-126: the smallest normal float32
            self.nu = nu + tn * (((nu + 2) / (nu + 1) + nu) / wn * (1 - k / nu) + k + eps - nu)
        self.m = self.m + t1 * (g - self.m)
        self.s = self.s + t2 * (d2 - self.s)
        self.e = self.e + t2 * (de - self.e)
        self.p1, self.p2 = self.p1 * ((1 - t1) if self.ab else b1), self.p2 * ((1 - t2) if self.ab else b2)
        second = self.s + self.m**2 if self.unc else self.s
        if self.ams:
            second = self.top = torch.maximum(self.ams * self.top, second)
        v = second + self.e
        self.x = self.x - self.lr * (self.m / (1 - self.p1)) / (v / (1 - self.p2)).sqrt()


def _grads(shapes, steps, seed=0):
    gen = torch.Generator().manual_seed(seed)
    for i in range(steps):
        scale = 100.0 if i % 7 == 3 else 1.0
        yield [scale * torch.randn(s, generator=gen, dtype=torch.float64) for s in shapes]


def _run(optim, params, grads):
    for gs in grads:
        for p, g in zip(params, gs, strict=True):
            p.grad = g.clone()
        optim.step()


OPTIONS = [
    {}, {"weight_decay": 0.1}, {"amsgrad": 0.9}, {"amsgrad": 1.0}, {"uncentered": True}, {"adaptive_bias": True},
    {"amsgrad": 0.9, "uncentered": True}, {"ini_dof": 5.0}, {"ini_dof": 1.0}, {"betas": (0.9, 0.9, 1.0)},
    {"k": 4.0, "ini_dof": 4.0, "betas": (0.9, 0.9, 1.0)}, {"k": math.inf},
    {"k": 3.0, "betas": (0.8, 0.99, 0.5), "eps": 1e-3, "lr": 0.1},
    {"skip_nonfinite": False},
]  # fmt: skip


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_equals_equations(options):
    shapes = [(4, 3), (3,), (1,), ()]
    start = next(_grads(shapes, 1, seed=9))
    params = [torch.nn.Parameter(x.clone()) for x in start]
    optim = AdaTerm(params, **options)
    kept = {n: v for n, v in options.items() if n != "skip_nonfinite"}
    references = [Reference(x, **kept) for x in start]
    for gs in _grads(shapes, 60):
        _run(optim, params, [gs])
        for p, r, g in zip(params, references, gs, strict=True):
            r.step(g)
            torch.testing.assert_close(p.detach(), r.x, rtol=1e-6, atol=1e-9)
            torch.testing.assert_close(optim.state[p]["nu"], torch.tensor(r.nu, dtype=p.dtype), rtol=1e-6, atol=0)


def test_members_are_independent():
    gs = list(_grads([(3, 4, 2), (3, 5)], 30))
    params = [torch.nn.Parameter(torch.ones(3, 4, 2).double()), torch.nn.Parameter(torch.ones(3, 5).double())]
    _run(AdaTerm(params, batch_dims=1), params, gs)
    for i in range(3):
        solo = [torch.nn.Parameter(torch.ones(4, 2).double()), torch.nn.Parameter(torch.ones(5).double())]
        _run(AdaTerm(solo), solo, [[g[i] for g in x] for x in gs])
        for p, s in zip(params, solo, strict=True):
            torch.testing.assert_close(p[i], s, rtol=1e-12, atol=0)


def test_groups_and_missing_gradients():
    a, b, c = (torch.nn.Parameter(torch.ones(2).double()) for _ in range(3))
    optim = AdaTerm([{"params": [a, c]}, {"params": [b], "lr": 0.0}])
    a.grad, b.grad = torch.ones(2).double(), torch.ones(2).double()
    optim.step()
    assert (a < 1).all()
    assert torch.equal(b, torch.ones(2).double())
    assert torch.equal(c, torch.ones(2).double())
    c.grad = torch.ones(2).double()
    optim.step()
    assert optim.state[a]["step"] == 2
    assert optim.state[c]["step"] == 1


@pytest.mark.parametrize("options", [{}, {"amsgrad": 0.9, "adaptive_bias": True}], ids=str)
def test_resume_is_exact(options):
    gs = list(_grads([(4, 3), (3,)], 20))
    params = [torch.nn.Parameter(torch.ones(4, 3)), torch.nn.Parameter(torch.ones(3))]
    gs = [[g.float() for g in x] for x in gs]
    optim = AdaTerm(params, **options)
    _run(optim, params, gs[:10])
    file = io.BytesIO()
    torch.save(optim.state_dict(), file)
    file.seek(0)
    resumed = copy.deepcopy(params)
    other = AdaTerm(resumed, **options)
    other.load_state_dict(torch.load(file, weights_only=True))
    _run(optim, params, gs[10:])
    _run(other, resumed, gs[10:])
    for p, r in zip(params, resumed, strict=True):
        assert torch.equal(p, r)
        for name, x in optim.state[p].items():
            assert torch.equal(x, other.state[r][name]), name


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_nonfinite_gradient_skips_its_tensor_only(value):
    a, b = torch.nn.Parameter(torch.ones(3)), torch.nn.Parameter(torch.ones(2))
    optim = AdaTerm([a, b], amsgrad=0.9, adaptive_bias=True)
    _run(optim, [a, b], [[torch.ones(3), torch.ones(2)]] * 2)
    before = {n: x.clone() for n, x in optim.state[a].items()}
    kept, moved = a.detach().clone(), b.detach().clone()
    _run(optim, [a, b], [[torch.tensor([1.0, value, 2.0]), torch.ones(2)]])
    assert torch.equal(a, kept)
    assert (b < moved).all()
    assert optim.state[a]["skipped"] == 1
    assert optim.state[b]["skipped"] == 0
    for name in set(before) - {"skipped"}:
        assert torch.equal(before[name], optim.state[a][name]), name


@pytest.mark.parametrize("scale", [0.0, 1.0, 1e-30, 1e30])
@pytest.mark.parametrize("shape", [(0,), (1,), (2, 3)])
@pytest.mark.parametrize("options", [{}, {"adaptive_bias": True}, {"uncentered": True}, {"k": math.inf}], ids=str)
def test_extremes_stay_finite(scale, shape, options):
    p = torch.nn.Parameter(torch.ones(shape))
    optim = AdaTerm([p], **options)
    for i in range(30):
        _run(optim, [p], [[torch.full(shape, scale if i % 3 else -scale)]])
    assert p.isfinite().all()
    assert all(x.isfinite().all() for n, x in optim.state[p].items() if n != "nu" or "k" not in options)


@pytest.mark.parametrize(
    ("options", "match"),
    [({"lr": -1.0}, "lr"), ({"betas": (0.9, 0.9)}, "betas"), ({"eps": 0.0}, "eps"), ({"k": 0.0}, "k must"),
     ({"amsgrad": 2.0}, "amsgrad"), ({"ini_dof": 0.5}, "ini_dof"), ({"batch_dims": 2}, "batch_dims"),
     ({"weight_decay": -1.0}, "weight_decay"), ({"betas": (0.9, 1.0, 0.9)}, r"betas\[1\]"),
     ({"betas": (0.9, 0.9, 1.1)}, r"betas\[2\]"), ({"betas": []}, "betas"), ({"batch_dims": -1}, "batch_dims")],
)  # fmt: skip
def test_wrong_arguments(options, match):
    with pytest.raises(ValueError, match=match):
        AdaTerm([torch.nn.Parameter(torch.ones(2))], **options)
    with pytest.raises(ValueError, match="float32 or float64"):
        AdaTerm([torch.nn.Parameter(torch.ones(2).half())])


NUMBERS = ("lr", "eps", "k", "weight_decay", "amsgrad", "ini_dof", "batch_dims")


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize("value", [math.nan, -math.inf, -1, None, "1", True, [], [1e-3, 1e-3], 1j], ids=str)
def test_every_number_is_checked(name, value):
    if (name, value) in (("ini_dof", None), ("batch_dims", True)):
        return
    with pytest.raises((TypeError, ValueError), match=f"^{name} must be"):
        AdaTerm([torch.nn.Parameter(torch.ones(2))], **{name: value})


@pytest.mark.parametrize("name", ["lr", "eps", "weight_decay", "amsgrad", "ini_dof"])
def test_infinity_is_refused_except_for_k(name):
    with pytest.raises(ValueError, match=f"^{name} must be"):
        AdaTerm([torch.nn.Parameter(torch.ones(2))], **{name: math.inf})


@pytest.mark.parametrize(
    "value", [None, 0.9, "0.9", 3, (0.9, None, 0.9), (0.9, 0.9, True), (0.9, math.nan, 0.9)], ids=str
)
def test_betas_are_three_numbers(value):
    with pytest.raises((TypeError, ValueError), match="^betas"):
        AdaTerm([torch.nn.Parameter(torch.ones(2))], betas=value)


@pytest.mark.parametrize("name", ["uncentered", "adaptive_bias", "skip_nonfinite"])
@pytest.mark.parametrize("value", [None, 1, "yes", 0.0], ids=str)
def test_switches_are_true_or_false(name, value):
    with pytest.raises(TypeError, match=f"^{name} must be True or False"):
        AdaTerm([torch.nn.Parameter(torch.ones(2))], **{name: value})


@pytest.mark.parametrize(
    "params", [None, [], 1.0, "weights", torch.nn.Linear(2, 2), torch.nn.Parameter(torch.ones(2)), [None], [1.0],
               {"params": []}, [{"lr": 1.0}], [{"params": None}], [torch.nn.Linear(2, 2)]],
    ids=lambda x: repr(x)[:20].replace(chr(10), ""),
)  # fmt: skip
def test_what_are_no_parameters_is_named(params):
    with pytest.raises((TypeError, ValueError), match="^params"):
        AdaTerm(params)


def test_options_of_a_group_are_checked_and_a_refused_group_leaves_no_trace():
    optim = AdaTerm([torch.nn.Parameter(torch.ones(2))])
    for wrong in ({"lr": math.nan}, {"eps": None}, {"betas": (0.9, 0.9)}):
        with pytest.raises((TypeError, ValueError), match=next(iter(wrong))):
            optim.add_param_group({"params": [torch.nn.Parameter(torch.ones(3))], **wrong})
        assert len(optim.param_groups) == 1


def test_named_parameters_and_a_learning_rate_in_a_tensor_are_taken():
    layer = torch.nn.Linear(2, 1)
    optim = AdaTerm(layer.named_parameters(), lr=torch.tensor(0.1))
    before = layer.weight.detach().clone()
    layer(torch.ones(2)).sum().backward()
    optim.step()
    assert isinstance(optim.param_groups[0]["lr"], torch.Tensor)
    assert (layer.weight < before).all()


def test_degrees_of_freedom_move_alike_in_both_data_types():
    nus = []
    for dtype in (torch.float32, torch.float64):
        p = torch.nn.Parameter(torch.ones(50, dtype=dtype))
        optim = AdaTerm([p], ini_dof=3.0)
        _run(optim, [p], [[torch.full((50,), 100.0, dtype=dtype)]])
        nus.append(optim.state[p]["nu"].item())
    # D = 1e14: w = 4e-14, w - ln w = 30.85, of 87.34 at most; nu* = (1.25 + 3) / 30.85 * (1 - 1/3) + 1 = 1.0918
    assert nus == pytest.approx([3 + 0.1 * 30.85 / 87.34 * (1.0918 - 3)] * 2, rel=1e-4)


def test_the_floor_is_added_after_the_maximum():
    p = torch.nn.Parameter(torch.zeros(1, dtype=torch.float64))
    optim = AdaTerm([p], lr=1.0, k=math.inf, eps=1.0, amsgrad=1.0)
    _run(optim, [p], [[torch.ones(1, dtype=torch.float64)]])
    # m = 0.1, c1 = 0.1; s = 0.1, c2 = 0.1: 1 / sqrt((0.1 + 1) / 0.1)
    assert p.item() == pytest.approx(-1 / math.sqrt(11.0), rel=1e-12)
    assert optim.state[p]["max_exp_avg_sq"].item() == pytest.approx(0.1, rel=1e-12)


def test_a_state_that_does_not_fit_says_what_it_is_of():
    layer, other = torch.nn.Linear(2, 1), torch.nn.Linear(3, 1)
    optim = AdaTerm(layer.parameters())
    with pytest.raises(ValueError, match="another optimizer than AdaTerm: its groups have no 'batch_dims'"):
        optim.load_state_dict(torch.optim.Adam(layer.parameters(), betas=(0.9, 0.9)).state_dict())
    filled = AdaTerm(other.parameters())
    other(torch.ones(3)).sum().backward()
    filled.step()
    optim.load_state_dict(filled.state_dict())
    layer(torch.ones(2)).sum().backward()
    with pytest.raises(ValueError, match=r"'exp_avg' has shape \(1, 3\).*\(1, 2\).*another network"):
        optim.step()


def test_a_large_floor_that_is_left_at_once_leaves_the_least_one():
    p = torch.nn.Parameter(torch.zeros(4))
    optim = AdaTerm([p], betas=(0.0, 0.0, 0.9))
    _run(optim, [p], [[torch.tensor([3e7, 1.0, 1.0, 1.0])], [torch.tensor([3e7, 1.0, 1.0, 1.0])]])
    assert optim.state[p]["floor"].min().item() >= 1e-10 * (1 - 1e-6)
    _run(optim, [p], [[torch.zeros(4)], [torch.full((4,), 1e-6)], [torch.zeros(4)]])
    assert optim.state[p]["floor"].min().item() >= 1e-10 * (1 - 1e-6)
    assert optim.state[p]["skipped"].item() == 0
    assert p.isfinite().all()
