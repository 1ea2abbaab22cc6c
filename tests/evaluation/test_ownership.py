"""What runs a policy leaves its mode, its memory and the random numbers as they were."""

from __future__ import annotations

import random
from functools import partial

import numpy as np
import pytest
import torch
from torch import nn

from torchrl_tsallis.evaluation import evaluate_policies, record_rollout
from torchrl_tsallis.evaluation.episodes import make_environment, run_episode, run_episodes
from torchrl_tsallis.evaluation.ownership import own_copy


class Counter:
    """Acts by the number of its calls since ``reset``: 0.1, 0.2, 0.3."""

    def __init__(self):
        self.calls = 7

    def reset(self):
        self.calls = 0

    def __call__(self, observation):
        self.calls += 1
        return np.full(2, 0.1 * self.calls)

    act = __call__


class Batched(Counter):
    batched = True

    def __call__(self, observations):
        assert observations.shape == (1, 2)
        return super().__call__(None)[None]


class Holder:
    def __init__(self, policy):
        self.policy = policy

    def __call__(self, observation):
        return self.policy(observation)


class Module(nn.Module):
    """Counts its calls in a buffer."""

    def __init__(self):
        super().__init__()
        self.register_buffer("calls", torch.tensor(7.0))

    def reset(self):
        self.calls = torch.tensor(0.0)

    def forward(self, observation):
        self.calls = self.calls + 1
        return 0.1 * self.calls.expand(2)


def _twice(policy, observation):
    return policy(observation)


def evaluate(policy, env_fn, **settings):
    settings = {"episodes": 6, "seed": 10, "workers": 0, "progress": False, **settings}
    return evaluate_policies({"p": policy}, env_fn=env_fn, **settings)


def _remembering():
    counter, held, part = Counter(), Holder(Counter()), Counter()
    return {
        "itself": (counter, counter),
        "its method": (counter.act, counter),
        "batched": (batched := Batched(), batched),
        "a network": (module := Module(), module),
        "held by a policy": (held, held.policy),
        "bound to a function": (partial(_twice, part), part),
    }


@pytest.mark.parametrize("kind", sorted(_remembering()))
def test_each_episode_of_a_policy_with_memory_is_as_if_run_alone(kind, make_env):
    policy, memory = _remembering()[kind]
    rows = evaluate(policy, make_env())
    # 2 x (0.1 + 0.2 + 0.3) in each episode
    assert [row["return"] for row in rows] == pytest.approx([1.2] * 6)
    assert memory.calls == 7


def test_run_episodes_and_run_episode_do_not_mix_memories_either(make_env):
    policy, env_fn = Counter(), make_env()
    envs = [make_environment(env_fn, 0) for _ in range(3)]
    assert [episode.total for episode in run_episodes(policy, envs, [1, 2, 3])] == pytest.approx([1.2] * 3)
    assert run_episode(policy, env_fn, 1) == (pytest.approx(1.2), 3)
    assert policy.calls == 7


def test_a_video_begins_with_a_fresh_memory_and_leaves_the_policy_its_own(make_env, tmp_path):
    pytest.importorskip("PIL")
    policy, env_fn = Counter(), make_env()
    record_rollout(policy, tmp_path / "a.gif", env_fn=env_fn, seconds=9, fps=1)
    assert [action[0] for action in env_fn.actions_seen] == pytest.approx([0.1, 0.2, 0.3])
    assert policy.calls == 7


class Locked(Counter):
    def __init__(self):
        super().__init__()
        self.door = (i for i in range(3))  # generators cannot be copied


class Demanding(Counter):
    def reset(self, seed):
        self.calls = seed


GLOBAL = Counter()


def names_a_global(observation):
    return GLOBAL(observation)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (Locked, r"copied for each episode, which fails \(.*generator.*copy.deepcopy can copy"),
        (Demanding, r"Demanding.reset\(\) cannot begin an episode.*it must take no argument"),
        (lambda: names_a_global, "a function that calls Counter, whose memory all episodes share: give"),
        (lambda: lambda observation, held=GLOBAL: held(observation), "a function that calls Counter"),
        (lambda: (lambda held: lambda observation: held(observation))(Counter()), "a function that calls Counter"),
    ],
)
def test_a_memory_that_cannot_be_fresh_is_refused_with_the_way_out(make, message, make_env):
    with pytest.raises(RuntimeError, match=message):
        evaluate(make(), make_env())


def test_what_has_no_memory_is_not_copied():
    class Plain:
        def __call__(self, observation):
            return observation

    policy = Plain()
    assert own_copy(policy) is policy and own_copy(np.tanh) is np.tanh
    env = make_resettable()
    assert own_copy(_reads(env)).__closure__[0].cell_contents is env  # has a reset, but is no policy


def make_resettable():
    class Robot:
        def reset(self): ...

    return Robot()


def _reads(env):
    return lambda observation: np.zeros(2) if env else None


class Dropping(nn.Module):
    """Zero actions with dropout, 0.5 without."""

    def __init__(self):
        super().__init__()
        self.inner = nn.Sequential(nn.Dropout(1.0), nn.Identity())
        self.frozen = nn.BatchNorm1d(2).eval()

    def forward(self, observation):
        torch.rand(()), np.random.rand(), random.random()
        return self.inner(torch.full((2,), 0.5))


NETWORK = Dropping()


def names_the_network(observation):
    return NETWORK(observation).numpy()


def _networks():
    network = Dropping()
    return {
        "a module": (network, network),
        "held by a policy": (Holder(network), network),
        "bound to a function": (partial(_twice, network), network),
        "in a closure": (lambda observation: network(observation), network),
        "a method": (network.forward, network),
        "a global of a function": (names_the_network, NETWORK),
    }


def _modes(network):
    return [module.training for module in network.modules()]


@pytest.mark.parametrize("kind", sorted(_networks()))
def test_a_network_in_training_is_evaluated_in_evaluation_mode_and_put_back(kind, make_env):
    policy, network = _networks()[kind]
    before = _modes(network)
    assert before == [True, True, True, True, False]
    assert [row["return"] for row in evaluate(policy, make_env(), episodes=2)] == [3.0, 3.0]
    assert _modes(network) == before


def test_modes_and_random_numbers_are_put_back_after_an_error(make_env, tmp_path):
    def broken(self, action):
        raise OSError("unplugged")

    def states():
        return torch.random.get_rng_state().tolist(), np.random.get_state()[1].tolist(), random.getstate()

    network = Dropping()
    for env_fn, error in ((make_env(), None), (make_env(step=broken), "unplugged")):
        before = states(), torch.get_num_threads()
        runs = [partial(evaluate, network, env_fn), partial(run_episode, network, env_fn, 3)]
        runs.append(partial(record_rollout, network, tmp_path / "a.gif", env_fn=env_fn, fps=1))
        for run in runs:
            if error:
                with pytest.raises(Exception, match=f"{error}|seed 3"):
                    run()
            else:
                run()
            assert (states(), torch.get_num_threads()) == before
            assert _modes(network) == [True, True, True, True, False]


def test_what_is_no_policy_is_named(make_env):
    for policy, message in (
        (3, "policy 'p' is an int"),
        (Counter, "policy 'p' is the class Counter"),
        ({"scale": np.ones(2)}, "policy 'p': cannot place 'scale'"),
        (None, "policy 'p' is an NoneType"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            evaluate(policy, make_env())
    for policies in (Counter(), {}, [Counter()]):
        with pytest.raises(ValueError, match="policies must be a mapping"):
            evaluate_policies(policies, env_fn=make_env(), workers=0)


@pytest.mark.parametrize("answer", [None, {"action": 1}, "left", [[1.0], [1.0, 2.0]], 1j * np.ones(2)])
def test_an_answer_that_is_no_action_is_named(answer, make_env):
    with pytest.raises(RuntimeError, match=r"episode 0 \(seed 10\) in Small failed.*needed is an array of numbers"):
        evaluate(lambda observation: answer, make_env())


def test_a_module_that_takes_tensors_is_told_how_to_be_an_actor(make_env):
    with pytest.raises(RuntimeError, match="cannot take a NumPy observation.*TensorDictModule"):
        evaluate(nn.Linear(2, 2), make_env())
