"""Actors of TorchRL as policies."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torch.distributions import Categorical
from torchrl.modules import (
    GRUModule,
    IndependentNormal,
    OneHotCategorical,
    ProbabilisticActor,
    QValueActor,
    set_recurrent_mode,
)

from torchrl_tsallis.evaluation import ActorPolicy, MeanPolicy, evaluate_policies
from torchrl_tsallis.modules import make_policy, make_recurrent_policy


def evaluate(policy, env_fn, **settings):
    settings = {"episodes": 5, "seed": 10, "workers": 0, "progress": False, **settings}
    return [row["return"] for row in evaluate_policies({"p": policy}, env_fn=env_fn, **settings)]


def make_gru(obs_dim=2, action_dim=2):
    gru = GRUModule(input_size=obs_dim, hidden_size=4, in_key="observation", out_key="features")
    head = TensorDictModule(nn.Linear(4, action_dim), in_keys=["features"], out_keys=["action"])
    return TensorDictSequential(gru, head)


class Adder(nn.Module):
    """Counts in a state that it writes in place: 0.1, 0.2, 0.3."""

    def forward(self, observation, count=None):
        count = torch.zeros(1, 1) if count is None else count
        return 0.1 * (count + 1).expand(1, 2), count + 1


def make_adder():
    return TensorDictModule(Adder(), in_keys=["observation", "count"], out_keys=["action", "count"])


def test_an_actor_gives_its_mean_in_any_mode_of_exploration():
    torch.manual_seed(0)
    actor = make_policy(3, 2)
    observation = np.array([0.1, -2.0, 0.3])
    mean = MeanPolicy.from_actor_state(actor.state_dict())(observation)
    np.testing.assert_allclose(ActorPolicy(actor)(observation), mean, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(ActorPolicy(actor)(observation), ActorPolicy(actor)(observation))


def test_an_actor_passed_as_it_is_gets_the_returns_of_its_state(make_env):
    torch.manual_seed(0)
    actor = make_policy(2, 2)
    np.testing.assert_allclose(evaluate(actor, make_env()), evaluate(actor.state_dict(), make_env()), rtol=1e-5)
    assert actor.training and all(parameter.grad is None for parameter in actor.parameters())


@pytest.mark.parametrize("make", [make_recurrent_policy, make_gru])
def test_a_recurrent_actor_acts_as_on_the_whole_sequence_and_begins_anew(make):
    torch.manual_seed(0)
    actor = make(2, 2).eval()
    observations = np.random.default_rng(0).normal(size=(5, 2)).astype(np.float32)
    data = TensorDict({"observation": torch.from_numpy(observations)[None]}, [1, 5])
    data["is_init"] = torch.zeros(1, 5, 1, dtype=torch.bool)
    with torch.no_grad(), set_recurrent_mode(True):
        written = actor(data)
    wanted = written.get("loc", written["action"])
    policy = ActorPolicy(actor)
    for _ in range(2):
        policy.reset()
        with set_recurrent_mode(True):  # of the caller: a policy is asked step by step all the same
            got = np.stack([policy(observation) for observation in observations])
        np.testing.assert_allclose(got, wanted[0].numpy(), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("make", [make_recurrent_policy, make_gru])
def test_episodes_of_a_recurrent_actor_do_not_mix(make, make_env):
    torch.manual_seed(0)
    actor, env_fn = make(2, 2), make_env()
    alone = [evaluate(actor, env_fn, episodes=1, seed=seed)[0] for seed in range(10, 15)]
    assert evaluate(actor, env_fn) == alone
    assert len(set(alone)) == 5
    assert actor.training


def test_a_state_that_is_written_in_place_is_carried_as_well(make_env):
    assert evaluate(make_adder(), make_env()) == pytest.approx([1.2] * 5)


def test_an_actor_survives_pickling():
    torch.manual_seed(0)
    policy = ActorPolicy(make_recurrent_policy(2, 2).eval())
    again = pickle.loads(pickle.dumps(policy))
    np.testing.assert_array_equal(again(np.ones(2)), policy(np.ones(2)))


def test_float64_observations_and_bfloat16_actors_meet():
    actor = TensorDictModule(nn.Linear(2, 2).bfloat16(), in_keys=["observation"], out_keys=["action"])
    assert ActorPolicy(actor)(np.ones(2)).dtype == np.float32
    double = TensorDictModule(nn.Linear(2, 2).double(), in_keys=["observation"], out_keys=["action"])
    assert ActorPolicy(double)(np.ones(2, np.float32)).dtype == np.float64


def test_entries_of_a_dict_observation_go_to_the_inputs_of_their_names(make_env):
    def look(self):
        return {"position": np.full(2, 0.25, np.float32), "arm": {"force": np.full(2, 0.5, np.float32)}, "rest": 1}

    class Sum(nn.Module):
        def forward(self, x, y):
            return x + y

    keys = ["position", ("arm", "force")]
    actor = TensorDictModule(Sum(), in_keys=keys, out_keys=["action"])
    assert evaluate(actor, make_env(look=look)) == [4.5] * 5
    wrong = TensorDictModule(Sum(), in_keys=["position", "velocity"], out_keys=["action"])
    with pytest.raises(RuntimeError, match=r"reads 'position', 'velocity', the observation has .*'arm', 'position'"):
        evaluate(wrong, make_env(look=look))


def _with_outputs(*outputs):
    return TensorDictModule(lambda x: tuple(x for _ in outputs), in_keys=["observation"], out_keys=list(outputs))


def _probabilistic(**options):
    network = TensorDictModule(lambda x: (x, x.exp()), in_keys=["observation"], out_keys=["loc", "scale"])
    return ProbabilisticActor(network, in_keys=["loc", "scale"], distribution_class=IndependentNormal, **options)


@pytest.mark.parametrize(
    "actor",
    [
        _with_outputs("hidden", "action"),
        _with_outputs(("agent", "action"), "loc"),
        _with_outputs("force"),
        _probabilistic(out_keys=["force"]),
        _probabilistic(out_keys=["force"], return_log_prob=True),
    ],
)
def test_the_action_is_found(actor):
    np.testing.assert_array_equal(ActorPolicy(actor)(np.array([0.5, -0.5])), np.array([0.5, -0.5], np.float32))


def test_unclear_keys_are_refused_by_name_and_can_be_named(make_env):
    with pytest.raises(ValueError, match="policy 'p': which output is the action, of 'left', 'right'.*action_key"):
        evaluate(_with_outputs("left", "right"), make_env())
    assert ActorPolicy(_with_outputs("left", "right"), action_key="left")(np.ones(1)) == [1.0]
    two = TensorDictModule(lambda x, y: x, in_keys=["observation", "mask"], out_keys=["action"])
    with pytest.raises(RuntimeError, match=r"reads 'observation', 'mask', the environment gives one.*observation_key"):
        evaluate(two, make_env())
    for cell in (lambda x, h: (x, h), lambda x, h: (x, h + 1), lambda x, h: (x, h.clone())):
        strict = TensorDictModule(cell, in_keys=["observation", "h"], out_keys=["action", ("next", "h")])
        with pytest.raises(RuntimeError, match="no initial value for its state 'h'.*start from zeros"):
            evaluate(strict, make_env())
    with pytest.raises(RuntimeError, match=r"cannot take observations of shape .*\(2,\).*trained in this environment"):
        evaluate(make_policy(3, 2), make_env())


def test_a_compiled_actor_is_run_as_it_was_before(make_env):
    torch.manual_seed(0)
    actor = make_policy(2, 2)
    assert evaluate(torch.compile(actor, backend="eager"), make_env()) == evaluate(actor, make_env())


@pytest.mark.parametrize("kind", ["one-hot", "categorical", "value"])
def test_torchrl_s_actors_of_discrete_actions_run(kind, make_env):
    spaces = pytest.importorskip("gymnasium").spaces
    torch.manual_seed(0)
    network = TensorDictModule(nn.Linear(2, 3), in_keys=["observation"], out_keys=["logits"])
    actor = {
        "one-hot": lambda: ProbabilisticActor(network, in_keys=["logits"], distribution_class=OneHotCategorical),
        "categorical": lambda: ProbabilisticActor(network, in_keys=["logits"], distribution_class=Categorical),
        "value": lambda: QValueActor(nn.Linear(2, 3), in_keys=["observation"], action_space="one_hot"),
    }[kind]()
    env_fn = make_env(action_space=spaces.Discrete(3))
    evaluate(actor, env_fn, episodes=1)
    linear = actor.get_submodule("module.0.module") if kind == "value" else network.module
    wanted = [int(linear(torch.tensor([10.0, t])).argmax()) for t in range(3)]
    assert env_fn.actions_seen == wanted
