from __future__ import annotations

import gc
import warnings

import numpy as np
import pytest

gym = pytest.importorskip("gymnasium")
pytest.importorskip("pybullet")

from torchrl_tsallis.data import load_policy  # noqa: E402
from torchrl_tsallis.envs import ENV_ID, make_ant, register_ant  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.fixture
def package():
    """The environment that ours equals."""
    pytest.importorskip("pybullet_envs_gymnasium")
    env = gym.make("AntBulletEnv-v0")
    yield env
    env.close()


@pytest.fixture
def env():
    env = make_ant()
    yield env
    env.close()


def make_actions(kind, seed):
    """Observation -> action; some actions leave [-1, 1]."""
    rng = np.random.default_rng(seed)
    expert = load_policy("expert_0")
    steps, held = 0, np.zeros(8, dtype=np.float32)

    def act(observation):
        nonlocal steps, held
        steps += 1
        if kind == "random":
            return rng.uniform(-1.5, 1.5, 8).astype(np.float32)
        if kind == "float64":
            return rng.uniform(-1.5, 1.5, 8)
        if kind == "held":
            if steps % 20 == 1:
                held = rng.uniform(-1, 1, 8).astype(np.float32)
            return held
        if kind == "bang-bang":
            if steps % 5 == 1:
                held = np.sign(rng.normal(size=8)).astype(np.float32)
            return held
        return expert.act(observation, rng, 0.2)

    return act


def episode(env, seed, kind, steps=1000):
    """Observations, rewards and ends of an episode; the actions' generator is seeded apart."""
    observation, _ = env.reset(seed=seed)
    act = make_actions(kind, 7)
    record = [(observation, 0.0, False, False)]
    for _ in range(steps):
        record.append(env.step(act(record[-1][0]))[:4])
        if record[-1][2] or record[-1][3]:
            break
    return record


def assert_same(a, b):
    assert len(a) == len(b)
    for x, y in zip(a, b, strict=True):
        assert x[0].dtype == y[0].dtype == np.float32
        np.testing.assert_array_equal(x[0], y[0])
        assert x[1:] == y[1:]


def test_equals_package(env, package):
    assert env.observation_space == package.observation_space
    assert env.action_space == package.action_space
    # The first one is unlike the others; the expert's is truncated, and holding an action falls from this start.
    plan = [
        (0, "random", 300),
        (None, "running", 1000),
        (3, "held", 1000),
        (None, "bang-bang", 300),
        (3, "float64", 300),
    ]
    ends = []
    for seed, kind, steps in plan:
        ours = episode(env, seed, kind, steps)
        assert_same(ours, episode(package, seed, kind, steps))
        ends.append(ours[-1][2:])
    assert ends == [(False, False), (False, True), (True, False), (False, False), (False, False)]


def test_image_equals_package():
    pytest.importorskip("pybullet_envs_gymnasium")
    images = []
    for make in (make_ant, lambda render_mode: gym.make("AntBulletEnv-v0", render_mode=render_mode)):
        env = make(render_mode="rgb_array")
        env.unwrapped._render_width, env.unwrapped._render_height = 64, 48
        env.reset(seed=0)
        env.step(np.ones(8, dtype=np.float32))
        images.append(env.render())
        env.close()
    assert images[0].shape == (48, 64, 3) and images[0].dtype == images[1].dtype == np.uint8
    np.testing.assert_array_equal(*images)


def test_image_size():
    env = make_ant(render_mode="rgb_array")
    env.reset(seed=0)
    assert env.render().shape == (240, 320, 3)
    env.close()


def test_reset_forgets_what_ran_before(env):
    fresh = make_ant()
    fresh.reset(seed=8)
    for seed, kind in [(3, "held"), (1, "running"), (1, "bang-bang")]:  # a fall, a walk, being thrown about
        episode(env, seed, kind)
    assert_same(episode(env, 5, "running", 300), episode(fresh, 5, "running", 300))
    fresh.close()


def test_two_environments_do_not_meet(env):
    alone = episode(env, 5, "random", 50)
    other = make_ant()
    other.reset(seed=5)
    again = episode(env, 5, "random", 0)
    act = make_actions("random", 7)
    for _ in range(50):
        other.step(np.ones(8, dtype=np.float32))
        again.append(env.step(act(again[-1][0]))[:4])
    other.close()
    assert_same(alone[2:], again[2:])  # the first reward of a fresh environment differs


def test_reset_after_close(env):
    first = episode(env, 5, "random", 20)
    env.close()
    env.close()
    assert_same(first, episode(env, 5, "random", 20))


def test_limit_and_registration(env):
    assert env.spec.max_episode_steps == 1000
    assert env.spec.id == ENV_ID
    register_ant()


def test_misuse_is_named(env):
    with pytest.raises(gym.error.ResetNeeded, match="before step"):
        env.step(np.zeros(8, dtype=np.float32))
    with pytest.raises(gym.error.ResetNeeded, match="before render"):
        env.unwrapped.render()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="must be finite"):
        env.step(np.full(8, np.inf, dtype=np.float32))


def test_nan_ends_the_episode(env):
    env.reset(seed=0)
    unwrapped = env.unwrapped
    unwrapped._initial_z = float("nan")
    observation, _, terminated, _, _ = env.step(np.zeros(8, dtype=np.float32))
    assert np.isnan(observation[0]) and terminated


def test_observation_is_clipped(env):
    env.reset(seed=0)
    env.unwrapped._initial_z = -20.0
    observation = env.step(np.zeros(8, dtype=np.float32))[0]
    assert observation[0] == 5 and observation.dtype == np.float32


def test_garbage_is_disconnected():
    import pybullet

    env = make_ant()
    env.reset(seed=0)
    client = env.unwrapped._client
    del env
    gc.collect()
    assert not pybullet.isConnected(client)


def test_quiet(capfd):
    env = make_ant()
    env.reset(seed=0)
    env.step(np.zeros(8, dtype=np.float32))
    env.close()
    out, err = capfd.readouterr()
    assert out == "" and err == ""


def test_checker(env):
    from gymnasium.utils.env_checker import check_env

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # the observations have no bounds, and only one render mode needs no display
        warnings.filterwarnings("ignore", message=".*(minimum|maximum) value is.*infinity.*")
        warnings.filterwarnings("ignore", message=".*render modes.*")
        check_env(env.unwrapped, skip_render_check=True)
