from __future__ import annotations

import os
import re
import subprocess
import sys

import numpy as np
import pytest
import torch

from torchrl_tsallis.data import load_policy
from torchrl_tsallis.envs import make_ant
from torchrl_tsallis.evaluation import MeanPolicy, evaluate_policies
from torchrl_tsallis.evaluation.episodes import run_episode
from torchrl_tsallis.modules import make_policy, make_recurrent_policy

# Written to a module of its own, because a spawned worker must be able to import it.
DUMMY = '''
import os
import pathlib
import types

import numpy as np

MARK = pathlib.Path(__file__).with_name("deaths")


class Env:
    action_space = types.SimpleNamespace(low=-np.ones(2, np.float32), high=np.ones(2, np.float32))

    def reset(self, seed=None):
        self.seed, self.steps = seed, 0
        return np.full(2, seed, np.float32), {}

    def step(self, action):
        self.steps += 1
        reward = float(action.sum()) + self.seed
        return np.zeros(2, np.float32), reward, False, self.steps == 3, {}

    def close(self):
        pass


class Fatal(Env):
    """Kills its process in episode 1 (seed 11): as often as the file says."""

    def step(self, action):
        # Only this episode reads the file, which another process would find empty while it is written.
        if self.seed == 11 and (left := int(MARK.read_text())) > 0:
            MARK.write_text(str(left - 1))
            os._exit(1)
        return super().step(action)


class Counted(Env):
    """Counts the environments that are open, and that were ever made."""

    open = made = 0

    def __init__(self):
        Counted.open += 1
        Counted.made += 1

    def close(self):
        Counted.open -= 1


class Failing(Env):
    """Fails in the second step of the episode of seed 11."""

    def step(self, action):
        if self.seed == 11 and self.steps == 1:
            raise OSError("unplugged")
        return super().step(action)


def broken():
    raise OSError("no such robot")


class Batched:
    """Acts on a batch of observations, and remembers the batches' sizes."""

    batched = True

    def __init__(self):
        self.sizes = []

    def __call__(self, observations):
        self.sizes.append(len(observations))
        return np.full((len(observations), 2), 0.5)


def picky(observation):
    assert observation.shape == (2,)
    return np.full(2, np.nan if observation[0] == 11 else 0.5)


class Remembering:
    """Acts by the number of its calls since ``reset``."""

    def __init__(self):
        self.calls = 7

    def reset(self):
        self.calls = 0

    def __call__(self, observation):
        self.calls += 1
        return np.full(2, 0.1 * self.calls)


def half(observation):
    return np.full(2, 0.5)


def big(observation):
    return np.full(2, 9.0)


def nan(observation):
    return np.full(2, np.nan)
'''


@pytest.fixture
def dummy(tmp_path, monkeypatch):
    (tmp_path / "dummy_rollout_env.py").write_text(DUMMY)
    (tmp_path / "deaths").write_text("0")
    monkeypatch.syspath_prepend(tmp_path)
    import dummy_rollout_env as module

    yield module
    monkeypatch.delitem(__import__("sys").modules, "dummy_rollout_env")


def test_mean_policy_equals_actor():
    torch.manual_seed(0)
    actor = make_policy(28, 8)
    with torch.no_grad():
        for name, value in actor.named_parameters():
            if value.ndim == 1 and name.endswith("weight"):
                value.uniform_(0.5, 2.0)
    observation = torch.randn(5, 28)
    loc = actor.get_dist(actor.module[0](_td(observation))).base_dist.loc
    mean = MeanPolicy.from_actor_state(actor.state_dict())(observation.numpy())
    assert mean.shape == (5, 8)
    np.testing.assert_allclose(mean, loc.detach().numpy(), rtol=1e-4, atol=1e-5)


def _td(observation):
    from tensordict import TensorDict

    return TensorDict({"observation": observation}, observation.shape[:1])


def test_mean_policy_by_hand():
    # [3, 4] / rms = [3, 4] / sqrt(12.5), times 2; then Squish; the mean is the first output.
    policy = MeanPolicy([(np.eye(2), np.zeros(2), np.full(2, 2.0)), (np.eye(2), np.ones(2), None)], eps=0.0)
    x = 2 * 3 / np.sqrt(12.5)
    np.testing.assert_allclose(policy(np.array([3.0, 4.0])), [x * (1 + x / np.sqrt(x * x + 4)) / 2 + 1], rtol=1e-6)


def test_bad_states():
    with pytest.raises(KeyError, match="no bias"):
        MeanPolicy.from_actor_state({"0.weight": np.eye(2)})
    with pytest.raises(ValueError, match="cannot place 'scale'"):
        MeanPolicy.from_actor_state({"scale": np.ones(2)})
    with pytest.raises(ValueError, match="even number"):
        MeanPolicy([(np.eye(3), np.zeros(3), None)])


def test_rows_by_hand(dummy):
    rows = evaluate_policies(
        {"half": dummy.half, "big": dummy.big}, episodes=2, seed=10, workers=0, env_fn=dummy.Env, progress=False
    )
    # three steps of seed + sum(action); 9 is clipped to 1
    assert rows == [
        {"policy": "half", "episode": 0, "seed": 10, "return": 33.0, "length": 3},
        {"policy": "half", "episode": 1, "seed": 11, "return": 36.0, "length": 3},
        {"policy": "big", "episode": 0, "seed": 10, "return": 36.0, "length": 3},
        {"policy": "big", "episode": 1, "seed": 11, "return": 39.0, "length": 3},
    ]


def test_failing_policy_is_named(dummy):
    with pytest.raises(RuntimeError, match=r"policy 'nan', episode 0 \(seed 10\).*finite action"):
        evaluate_policies({"nan": dummy.nan}, episodes=1, seed=10, workers=0, env_fn=dummy.Env, progress=False)


def test_unpicklable_policy_is_named(dummy):
    with pytest.raises(ValueError, match="'mine' cannot be pickled"):
        evaluate_policies({"mine": lambda o: o}, episodes=1, workers=1, env_fn=dummy.Env, progress=False)


def test_dead_worker_is_replaced(dummy, tmp_path):
    (tmp_path / "deaths").write_text("1")
    rows = evaluate_policies(
        {"half": dummy.half}, episodes=3, seed=10, workers=2, env_fn="dummy_rollout_env:Fatal", progress=False
    )
    assert [row["return"] for row in rows] == [33.0, 36.0, 39.0]
    assert (tmp_path / "deaths").read_text() == "0"


def test_worker_that_keeps_dying_is_named(dummy, tmp_path):
    (tmp_path / "deaths").write_text("99")
    with pytest.raises(RuntimeError, match="died 2 times on 'half' episode 1:"):
        evaluate_policies(
            {"half": dummy.half}, episodes=2, seed=10, workers=1, retries=1, env_fn=dummy.Fatal, progress=False
        )
    assert (tmp_path / "deaths").read_text() == "97"


def test_failing_episode_of_a_group_is_named(dummy):
    with pytest.raises(RuntimeError, match=r"policy 'half', episode 1 \(seed 11\).*unplugged"):
        evaluate_policies({"half": dummy.half}, episodes=3, seed=10, workers=0, env_fn=dummy.Failing, progress=False)
    with pytest.raises(RuntimeError, match=r"policy 'picky', episode 1 \(seed 11\).*step 0: need a finite action"):
        evaluate_policies({"picky": dummy.picky}, episodes=3, seed=10, workers=0, env_fn=dummy.Env, progress=False)
    with pytest.raises(RuntimeError, match=r"policy 'half', episode 0 \(seed 10\).*no such robot"):
        evaluate_policies({"half": dummy.half}, episodes=3, seed=10, workers=0, env_fn=dummy.broken, progress=False)


def test_environments_are_used_again_and_closed(dummy):
    policies = {"half": dummy.half, "batched": dummy.Batched()}
    rows = evaluate_policies(policies, episodes=21, seed=10, workers=0, env_fn=dummy.Counted, progress=False)
    # 21 episodes are 6 groups of at most 4, each of 3 steps
    assert (dummy.Counted.made, dummy.Counted.open) == (4, 0)
    assert policies["batched"].sizes == [4] * 9 + [3] * 9
    assert [row["return"] for row in rows] == [3.0 * (1 + seed) for seed in range(10, 31)] * 2


def test_action_of_a_row_does_not_depend_on_the_batch():
    rng = np.random.default_rng(0)
    for width in (1, 2, 7, 33, 100, 256):
        shapes = [(width, 28), (width, width), (6, width)]
        layers = [(rng.normal(size=s), rng.normal(size=s[0]), rng.normal(size=s[0])) for s in shapes]
        policy = MeanPolicy([*layers[:2], (*layers[2][:2], None)])
        observations = rng.normal(size=(17, 28)).astype(np.float32)
        alone = np.stack([policy(observation) for observation in observations])
        for size in (1, 2, 3, 8, 17):
            np.testing.assert_array_equal(policy(observations[:size]), alone[:size])


def test_networks_and_memories_give_the_same_in_workers_as_in_this_process(dummy):
    torch.manual_seed(0)
    actor, recurrent = make_policy(2, 2), make_recurrent_policy(2, 2, state_noise=0.5)
    policies = {"actor": actor, "recurrent": recurrent, "remembering": dummy.Remembering()}
    results = [
        evaluate_policies(policies, episodes=5, seed=10, workers=workers, env_fn=dummy.Env, progress=False)
        for workers in (0, 1)
    ]
    assert results[0] == results[1]
    # 3 x the seed and 2 x (0.1 + 0.2 + 0.3)
    assert [row["return"] for row in results[1][10:]] == pytest.approx([3 * seed + 1.2 for seed in range(10, 15)])
    assert actor.training and recurrent.training and policies["remembering"].calls == 7


IMPORTS = "import dummy_rollout_env as dummy\nfrom torchrl_tsallis.evaluation import evaluate_policies\n"
RUN = "evaluate_policies({{'mine': {}}}, episodes=2, workers=1, env_fn={}, progress=False)\n"
MAIN = f"{IMPORTS}if __name__ == '__main__':\n    def mine(*_):\n        return dummy.half(*_)\n    "
SCRIPTS = {
    "without a guard": (IMPORTS + RUN.format("dummy.half", "dummy.Env"), "put what .* `if __name__ == .__main__.:`"),
    "a policy that a worker cannot import": (
        MAIN + RUN.format("mine", "dummy.Env"),
        r"policy 'mine' cannot be loaded in a worker process \(AttributeError.*define it in a module",
    ),
    "an environment that a worker cannot import": (
        MAIN + RUN.format("dummy.half", "mine"),
        r"env_fn cannot be loaded in a worker process \(AttributeError.*define it in a module",
    ),
}


@pytest.mark.parametrize("kind", SCRIPTS)
def test_a_script_whose_workers_cannot_start_is_told_what_to_do(kind, dummy, tmp_path):
    text, said = SCRIPTS[kind]
    (tmp_path / "script.py").write_text(text)
    paths = os.pathsep.join([str(tmp_path), *sys.path])
    environment = os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(tmp_path / "script.py")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    last = done.stderr.strip().splitlines()[-1]
    assert done.returncode == 1 and last.startswith("RuntimeError: ") and re.search(said, last)
    assert last.endswith("or use workers=0") and "check memory" not in done.stderr


@pytest.mark.filterwarnings("ignore")
def test_ant_does_not_depend_on_workers_and_groups(monkeypatch):
    pytest.importorskip("pybullet")
    rng = np.random.default_rng(0)
    layers = [(rng.normal(size=(100, 28)) / 5, np.zeros(100), np.ones(100)), (rng.normal(size=(16, 100)), np.zeros(16))]
    policies = {"mean": MeanPolicy([layers[0], (*layers[1], None)]), "expert": load_policy("expert_0")}
    results = []
    for workers, group in [(0, 4), (0, 1), (2, 2)]:
        monkeypatch.setattr("torchrl_tsallis.evaluation.rollouts.GROUP", group)
        results.append(evaluate_policies(policies, env_fn=make_ant, episodes=3, workers=workers, progress=False))
    assert results[0] == results[1] == results[2]
    assert results[0][0]["return"] != results[0][1]["return"]
    for row in (results[0][2], results[0][5]):  # the last of each policy, in a fresh environment
        alone = run_episode(policies[row["policy"]], "torchrl_tsallis.envs:make_ant", row["seed"])
        assert alone == (row["return"], row["length"])
