"""An actor's distribution without the tensordicts in between equals the one with them."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import distributions as d
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor

from torchrl_tsallis.modules import make_policy
from torchrl_tsallis.objectives import actor as actor_module
from torchrl_tsallis.objectives.actor import get_dist, get_stacked_dist


def inputs() -> TensorDict:
    return TensorDict({"observation": torch.randn(5, 3)}, [5])


def single_output() -> ProbabilisticActor:
    module = TensorDictModule(nn.Linear(3, 4), in_keys=["observation"], out_keys=["logits"])
    return ProbabilisticActor(module, in_keys=["logits"], distribution_class=d.Categorical)


def three_modules() -> ProbabilisticActor:
    body = TensorDictModule(nn.Linear(3, 4), in_keys=["observation"], out_keys=["hidden"])
    head = TensorDictModule(lambda x: (x, x.exp()), in_keys=["hidden"], out_keys=["loc", "scale"])
    module = TensorDictSequential(body, head)
    return ProbabilisticActor(module, in_keys=["loc", "scale"], distribution_class=IndependentNormal)


@pytest.mark.parametrize("make", [lambda: make_policy(3, 2), single_output, three_modules])
def test_equals_the_actors_own(make):
    actor, data = make(), inputs()
    got, expected = get_dist(actor, data), actor.get_dist(data.copy())
    assert type(got) is type(expected)
    assert got.batch_shape == (5,)
    action = expected.sample()
    assert torch.equal(got.log_prob(action), expected.log_prob(action))
    assert set(data.keys()) == {"observation"}


def test_a_hook_is_not_passed_over():
    actor, calls = make_policy(3, 2), []
    actor.module[0].register_forward_hook(lambda *_: calls.append(1))
    get_dist(actor, inputs())
    assert calls == [1]


def test_stackable_modules_give_what_vmap_gives(monkeypatch):
    actors = [make_policy(3, 2, hidden=(8,)) for _ in range(3)]
    params = TensorDict.from_modules(*actors, as_module=True)
    data, action = TensorDict({"observation": torch.randn(3, 5, 3)}, [3, 5]), torch.randn(3, 5, 2)
    by_products = get_stacked_dist(actors[0], data, params).log_prob(action)
    monkeypatch.setattr(actor_module, "_is_stackable", lambda module: False)
    torch.testing.assert_close(get_stacked_dist(actors[0], data, params).log_prob(action), by_products)
    solo = torch.stack([a.get_dist(row).log_prob(x) for a, row, x in zip(actors, data, action, strict=True)])
    torch.testing.assert_close(by_products, solo)
