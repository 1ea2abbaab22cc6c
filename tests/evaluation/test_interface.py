"""What environments may answer, and what policies may."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from torchrl_tsallis.evaluation import evaluate_policies
from torchrl_tsallis.evaluation.interface import ActionRule

spaces = pytest.importorskip("gymnasium").spaces


def evaluate(policy, env_fn, **settings):
    settings = {"episodes": 2, "seed": 10, "workers": 0, "progress": False, **settings}
    return evaluate_policies({"p": policy}, env_fn=env_fn, **settings)


def constant(action):
    return lambda observation: action


@pytest.mark.parametrize(
    ("space", "action", "taken"),
    [
        (spaces.Box(-1, 1, (2,), np.float32), [9.0, -0.5], np.array([1, -0.5], np.float32)),
        (spaces.Box(-1, 1, (2, 1), np.float64), [[9.0], [-0.5]], np.array([[1], [-0.5]])),
        (spaces.Box(0, 9, (2,), np.int64), [12.0, 3.0], np.array([9, 3])),
        (spaces.Box(-1, 1, (), np.float32), 0.5, np.array(0.5, np.float32)),
        (spaces.Discrete(3), 2, np.int64(2)),
        (spaces.Discrete(3, start=-1), np.float32(-1.0), np.int64(-1)),
        (spaces.Discrete(3), [0, 0, 1], np.int64(2)),
        (spaces.Discrete(3, start=5), [False, True, False], np.int64(6)),
        (spaces.MultiDiscrete([2, 5]), [1.0, 4.0], np.array([1, 4])),
        (spaces.MultiDiscrete([2, 5], start=[7, -3]), [8, -3], np.array([8, -3])),
        (spaces.MultiBinary(3), [True, False, True], np.array([1, 0, 1], np.int8)),
        (spaces.MultiBinary([2, 1]), [[1.0], [0.0]], np.array([[1], [0]], np.int8)),
    ],
)
def test_actions_are_of_the_space_with_its_type(space, action, taken, make_env):
    env_fn = make_env(action_space=space)
    evaluate(constant(action), env_fn)
    for given in env_fn.actions_seen:
        np.testing.assert_array_equal(given, taken)
        assert given.dtype == taken.dtype and space.contains(given)
    assert len(env_fn.actions_seen) == 6


@pytest.mark.parametrize(
    ("space", "action", "message"),
    [
        (spaces.Discrete(3), 3, "from 0 to 2 for Small, got 3"),
        (spaces.Discrete(3), 0.5, "whole numbers, from 0 to 2 for Small, got 0.5"),
        (spaces.Discrete(3), [0.0, 1.0, 0.0], r"shape \(\), from 0 to 2 .*return np.argmax"),
        (spaces.Discrete(3), [1, 1, 0], r"shape \(\), from 0 to 2"),
        (spaces.Discrete(3), [0, 0, 0], r"shape \(\), from 0 to 2"),
        (spaces.Discrete(3), [0, 2, -1], r"shape \(\), from 0 to 2"),
        (spaces.Discrete(3), np.nan, "finite"),
        (spaces.MultiDiscrete([2, 5]), [1, 5], r"from \[0 0\] to \[1 4\]"),
        (spaces.MultiDiscrete([2, 5]), [1, 1, 1], r"shape \(2,\)"),
        (spaces.MultiBinary(2), [0, 2], "from 0 to 1"),
        (spaces.MultiBinary(2), [0.0, 0.5], "whole numbers, from 0 to 1"),
        (spaces.Box(0, 9, (2,), np.int64), [0.5, 1.0], "whole numbers for Small"),
        (spaces.Box(-1, 1, (2,), np.float32), [np.inf, 1.0], r"finite action of shape \(2,\) for Small"),
        (spaces.Box(-1, 1, (2,), np.float32), 0.5, r"finite action of shape \(2,\) for Small"),
    ],
)
def test_actions_outside_of_the_space_are_refused_not_rounded(space, action, message, make_env):
    with pytest.raises(RuntimeError, match=rf"episode 0 \(seed 10\) in Small failed: .*step 0: .*{message}"):
        evaluate(constant(action), make_env(action_space=space))


@pytest.mark.parametrize(
    "space",
    [
        spaces.Dict({"a": spaces.Discrete(2)}),
        spaces.Tuple([spaces.Discrete(2)]),
        spaces.Text(3),
        spaces.Sequence(spaces.Discrete(2)),
        spaces.Graph(spaces.Discrete(2), None),
    ],
)
def test_other_action_spaces_are_refused_by_name(space, make_env):
    env_fn = make_env(action_space=space)
    with pytest.raises(RuntimeError, match=f"the action space of Small is {type(space).__name__}: .*wrap"):
        evaluate(constant(0), env_fn)
    assert env_fn.closed == 1


def test_observations_of_several_parts_reach_the_policy_as_they_are(make_env):
    seen = []

    def policy(observation):
        seen.append(observation)
        return np.zeros(2)

    def look(self):
        return {"t": self.t, "image": np.zeros((2, 2, 3), np.uint8)}

    evaluate(policy, make_env(look=look, observation_space=spaces.Dict({})), episodes=1)
    assert [observation["t"] for observation in seen] == [0, 1, 2]
    assert seen[0]["image"].dtype == np.uint8


def test_a_batched_policy_refuses_observations_of_several_parts(make_env):
    class Batched:
        batched = True

        def __call__(self, observations):
            return np.zeros((len(observations), 2))

    for look in (lambda self: {"t": 1}, lambda self: (1, 2), lambda self: {"a": {"b": np.zeros(2)}}):
        with pytest.raises(RuntimeError, match="Small has several parts.*FlattenObservation"):
            evaluate(Batched(), make_env(look=look))
    wrong = type("Wrong", (Batched,), {"__call__": lambda self, observations: np.zeros(2)})
    with pytest.raises(RuntimeError, match=r"gave shape \(2,\) for 1 observations"):
        evaluate(wrong(), make_env(), episodes=1)


BOX = spaces.Box(-9, 9, (2,), np.float32)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"reset": lambda self, seed=None: np.zeros(2)}, "reset of Small gave a ndarray, needed is .observation, info"),
        ({"reset": lambda self, seed=None: (1, 2, 3)}, "reset of Small gave 3 values"),
        ({"reset": lambda self, seed=None: {"observation": 1}}, "reset of Small gave a dict"),
        ({"step": lambda self, action: (np.zeros(2), 0.0, True, {})}, "step of Small gave 4 values.*older gym"),
        ({"step": lambda self, action: np.zeros(2)}, "step of Small gave a ndarray"),
        ({"step": lambda self, action: (np.zeros(2), np.zeros(1), True, False, {})}, r"a reward of shape \(1,\)"),
        ({"step": lambda self, action: (np.zeros(2), 0, np.zeros(3), False, {})}, r"a terminated of shape \(3,\)"),
        ({"step": lambda self, action: (np.zeros(2), 0, False, [True], {})}, r"a truncated of shape \(1,\)"),
        ({"step": lambda self, action: (np.zeros(2), np.nan, True, False, {})}, "rewards of Small sum to nan"),
        ({"step": lambda self, action: (np.zeros(2), -np.inf, True, False, {})}, "rewards of Small sum to -inf"),
        ({"step": lambda self, action: (np.zeros(3), 0, True, False, {}), "observation_space": BOX}, r"\(3,\).*\(2,\)"),
        ({"look": lambda self: np.zeros((2, 1)), "observation_space": BOX}, r"reset of Small.*\(2, 1\).*\(2,\)"),
        ({"num_envs": 4}, "Small is a vector environment"),
        ({"reset": lambda self: np.zeros(2)}, r"reset of Small takes no seed, needed is reset\(seed=...\)"),
        ({"reset": None}, "env_fn made a Small, needed is an environment with reset and step"),
    ],
)
def test_answers_of_another_form_name_environment_and_fix(changes, message, make_env):
    with pytest.raises(RuntimeError, match=message):
        evaluate(constant(np.zeros(2)), make_env(**changes))


def test_what_is_no_environment_at_all_is_named():
    for made, name in ((None, "NoneType"), (3, "int"), (np.zeros, "function")):
        with pytest.raises(RuntimeError, match=f"env_fn made a .*{name}.*, needed is an environment"):
            evaluate(constant(np.zeros(2)), lambda made=made: made)


def test_an_action_that_is_not_finite_for_an_observation_that_is_not_either_says_whose_fault_it_is(make_env):
    with pytest.raises(RuntimeError, match="observation is not finite either, which is the environment's fault"):
        evaluate(lambda observation: observation, make_env(look=lambda self: np.full(2, np.nan, np.float32)))


def test_an_environment_without_an_end_is_cut_marked_and_said(make_env, caplog):
    with caplog.at_level(logging.WARNING):
        rows = evaluate(constant(np.full(2, 0.5)), make_env(steps=None), max_steps=7)
    row = {"policy": "p", "episode": 0, "seed": 10, "return": 7.0, "length": 7, "truncated": True}
    assert rows == [row, row | {"episode": 1, "seed": 11}]
    assert "'p': 2 of 2 episodes were ended at max_steps=7" in caplog.text


def test_an_episode_that_ends_by_itself_at_the_longest_length_is_not_marked(make_env, caplog):
    with caplog.at_level(logging.WARNING):
        rows = evaluate(constant(np.zeros(2)), make_env(steps=7), max_steps=7)
    assert [set(row) for row in rows] == [{"policy", "episode", "seed", "return", "length"}] * 2
    assert not caplog.text


def test_only_the_episodes_that_were_cut_are_marked(make_env, caplog):
    def step(self, action):
        self.t += 1
        return self.look(), 1.0, self.seed % 2 == 0 and self.t == 3, False, {}

    with caplog.at_level(logging.WARNING):
        rows = evaluate(constant(np.zeros(2)), make_env(step=step), episodes=5, max_steps=6)
    assert [(row["return"], row.get("truncated", False)) for row in rows] == [
        (3.0, False), (6.0, True), (3.0, False), (6.0, True), (3.0, False),
    ]  # fmt: skip
    assert "2 of 5 episodes" in caplog.text


def test_the_default_longest_episode_is_finite(make_env):
    assert evaluate(constant(np.zeros(2)), make_env(steps=None), episodes=1)[0]["length"] == 10_000


def test_gymnasium_s_own_environments_of_discrete_actions_run():
    import gymnasium

    rows = evaluate(constant(1), lambda: gymnasium.make("CartPole-v1"))
    assert [row["return"] for row in rows] == [float(row["length"]) for row in rows]
    assert ActionRule(gymnasium.make("CartPole-v1")).env == "CartPole-v1"
