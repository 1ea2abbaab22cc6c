"""Contract of a rating as an object: the page's example, settings of members, and the batch behind it."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

from torchrl_tsallis import PeakRating, TsallisBCLoss, TsallisRating
from torchrl_tsallis.modules import make_policy
from torchrl_tsallis.ratings import Rating
from torchrl_tsallis.ratings.running import RunningMean

PAGE = Path(__file__).parents[2] / "docs" / "ratings.md"


@pytest.fixture
def trimmed():
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    names: dict = {}
    exec(next(block for block in blocks if "class TrimmedRating" in block), names)  # noqa: S102
    return names["TrimmedRating"]


def batch(*shape: int) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    observation = torch.randn(*shape, 3, generator=generator)
    return TensorDict({"observation": observation, "action": observation[..., :2].tanh()}, shape)


def test_the_pages_rating_works_alone_masked_and_with_members(trimmed):
    torch.manual_seed(0)
    actors = [make_policy(3, 2, hidden=(4,)) for _ in range(2)]
    data = batch(2, 8)
    data["action"][:, 0] += 50.0
    stacked = TsallisBCLoss(actors, rating=trimmed([5.0, 1e6]))
    out = stacked(data)
    torch.testing.assert_close(stacked.rating(data)[0], (torch.arange(8) > 0).float())
    assert (stacked.rating(data)[1] == 1).all()
    alone = TsallisBCLoss(actors[0], rating=trimmed(5.0))
    torch.testing.assert_close(alone(data[0])["threshold"], out["threshold"][0])
    padded = TensorDict.cat([data[0], data[0][:2] * math.nan])
    padded["collector", "mask"] = torch.arange(10) < 8
    torch.testing.assert_close(alone(padded), alone(data[0]))
    assert alone.rating(padded)[8:].isnan().all()
    with pytest.raises(ValueError, match="nothing tunes TrimmedRating|TrimmedRating"):
        from torchrl_tsallis import QTuner

        QTuner(alone)


def test_the_short_form_is_the_papers_rating():
    for settings in ({"q": 0.7}, {"gamma_mix": 0.3}, {"q": 1.0, "gamma_mix": 0.0}, {}):
        outs = []
        for kwargs in (settings, {"rating": TsallisRating(**settings)}):
            torch.manual_seed(0)
            loss = TsallisBCLoss(make_policy(3, 2, hidden=(4,)), **kwargs)
            if loss.needs_target:
                SoftUpdate(loss, tau=0.1)
            outs.append(loss(batch(5)))
        assert (outs[0] == outs[1]).all()


@pytest.mark.parametrize(
    ("kwargs", "match"),
    [
        ({"rating": PeakRating(), "q": 0.8}, "q are settings of TsallisRating"),
        ({"q": None}, "q must be a number"),
        ({"q": math.nan}, "q must be a number"),
        ({"gamma_mix": None}, "gamma_mix"),
        ({"gamma_min": math.nan}, "gamma_min"),
        ({"gamma_max": "large"}, "gamma_max"),
        ({"beta": -1}, "beta"),
        ({"q": [0.8, 0.7]}, "q has 2 values for 1 policies"),
        ({"reduction": "median"}, "reduction"),
    ],
)
def test_settings_are_named(kwargs, match):
    with pytest.raises(ValueError, match=match):
        TsallisBCLoss(make_policy(3, 2), **kwargs)


@pytest.mark.parametrize("actor", [None, torch.nn.Linear(3, 2), "actor", [None], 3])
def test_what_is_no_actor_is_named(actor):
    with pytest.raises(TypeError, match="must be a stochastic actor.*ProbabilisticActor"):
        TsallisBCLoss(actor)


def test_lists_of_actors_are_checked():
    with pytest.raises(ValueError, match="list of actors is empty"):
        TsallisBCLoss([])
    with pytest.raises(ValueError, match=r"weight' is \[8, 3\] in actor 0 and \[9, 3\] in actor 1"):
        TsallisBCLoss([make_policy(3, 2, hidden=(width,)) for width in (8, 9)])
    with pytest.raises(TypeError, match="rating must be a Rating"):
        TsallisBCLoss(make_policy(3, 2), rating=0.8)


@pytest.mark.parametrize("key", [3, (), ("robot", 3), "", ["action"]])
def test_keys_are_checked(key):
    with pytest.raises(TypeError, match="action must be a key"):
        TsallisBCLoss(make_policy(3, 2), gamma_mix=0.0).set_keys(action=key)


@pytest.mark.parametrize("members", [None, 2])
@pytest.mark.parametrize(
    ("observation", "error", "match"),
    [
        (lambda x: x.double(), TypeError, r"'observation' \[.*3\] torch.float64.*float32"),
        (lambda x: x.half(), TypeError, r"'observation' \[.*3\] torch.float16.*float32"),
        (lambda x: x.long(), TypeError, r"'observation' \[.*3\] torch.int64.*float32"),
        (lambda x: x[..., :2], ValueError, r"'observation' \[.*2\].*size"),
    ],
)
def test_observations_of_another_type_or_size_are_named(observation, error, match, members):
    actors = make_policy(3, 2) if members is None else [make_policy(3, 2) for _ in range(members)]
    loss = TsallisBCLoss(actors, gamma_mix=0.0)
    data = batch(5) if members is None else batch(members, 5)
    data["observation"] = observation(data["observation"])
    with pytest.raises(error, match=match):
        loss(data)
    loss(batch(5) if members is None else batch(members, 5))  # the failure leaves the loss usable


@pytest.mark.parametrize("gamma_mix", [0.0, 0.5])
def test_a_batch_without_its_batch_size_is_taken(gamma_mix):
    loss = TsallisBCLoss(make_policy(3, 2, hidden=(4,)), gamma_mix=gamma_mix)
    if gamma_mix:
        SoftUpdate(loss, tau=0.1)
    data = batch(5)
    bare = TensorDict(dict(data.items()), [])
    torch.testing.assert_close(loss(bare), loss(data))
    torch.testing.assert_close(loss.rating(bare), loss.rating(data))


def test_members_by_gamma_zero_are_not_rated_by_the_target():
    actors = [make_policy(3, 2, hidden=(4,)) for _ in range(3)]
    loss = TsallisBCLoss(actors, rating=TsallisRating(gamma_mix=[0.0, "adaptive", 0.5]))
    assert loss.target_members.tolist() == [False, True, True]
    assert TsallisBCLoss(make_policy(3, 2)).target_members is None
    with pytest.raises(ValueError, match="gamma_mix has 2 values for 3 policies"):
        TsallisBCLoss(actors, rating=TsallisRating(gamma_mix=[0.5, 0.5]))
    shared = TsallisRating()
    TsallisBCLoss(actors, rating=shared)
    with pytest.raises(ValueError, match="each loss a rating of its own"):
        TsallisBCLoss(actors[:2], rating=shared)


def test_the_adaptive_level_is_frozen_in_evaluation():
    torch.manual_seed(0)
    loss = TsallisBCLoss(make_policy(3, 2))
    SoftUpdate(loss, tau=0.1)
    first, second = batch(16), batch(16)
    second["action"] = second["action"] + 2.0
    moments = []
    for data in (first, second):
        out = loss(data)
        moments.append(out["bound"] * (1 - out["gamma_mix"]))
    frozen = 0.9 * moments[0] + 0.1 * moments[1]
    out = loss.eval()(second)
    torch.testing.assert_close(out["bound"] * (1 - out["gamma_mix"]), frozen)
    torch.testing.assert_close(loss.rating(second)[:3], loss.rating(second[:3]))
    torch.testing.assert_close(loss.rating(second, chunk_size=5), loss.rating(second))


def test_a_running_mean_says_that_it_has_seen_nothing():
    mean = RunningMean().eval()
    with pytest.warns(UserWarning, match="no batch was seen in training mode"):
        assert mean(torch.tensor(3.0)) == 3.0
    mean.train()
    mean(torch.tensor(math.nan))
    assert mean.value == 0 and not mean.batches
    mean(torch.tensor(2.0))
    assert mean.eval()(torch.tensor(7.0)) == 2.0


def test_modes_are_put_back_even_after_an_error():
    loss = TsallisBCLoss(make_policy(3, 2), gamma_mix=0.0)
    loss.actor_network.module[0].eval()
    with pytest.raises(KeyError):
        loss.rating(batch(3).exclude("action"))
    assert loss.training and loss.actor_network.training and not loss.actor_network.module[0].training


def test_vmap_randomness_can_be_set():
    loss = TsallisBCLoss([make_policy(3, 2) for _ in range(2)], gamma_mix=0.0)
    loss.set_vmap_randomness("different")
    assert loss.vmap_randomness == "different"


def test_a_rating_without_forward_is_no_rating():
    with pytest.raises(NotImplementedError):
        TsallisBCLoss(make_policy(3, 2), rating=Rating())(batch(2))


@pytest.mark.parametrize("q", [1.0, 0.8])
@pytest.mark.parametrize("action", [1e20, math.inf])
def test_the_papers_rating_of_an_action_at_infinity(q, action):
    loss = TsallisBCLoss(make_policy(3, 2), q=q, gamma_mix=0.0)
    data = batch(4)
    clean = torch.autograd.grad(loss(data[1:])["loss_tsallis_bc"], list(loss.parameters()))
    data["action"][0] = action
    out = loss(data)
    grads = torch.autograd.grad(out["loss_tsallis_bc"], list(loss.parameters()))
    torch.testing.assert_close([g * 4 / 3 for g in grads], list(clean))
    assert out["loss_tsallis_bc"].isfinite() == (q < 1), (
        "plain behavioral cloning has no finite loss: the step is skipped"
    )
    assert loss.rating(data)[0] == (q == 1)
