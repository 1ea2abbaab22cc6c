from __future__ import annotations

import warnings

import numpy as np
import pytest

gym = pytest.importorskip("gymnasium")
pytest.importorskip("pybullet")
pytest.importorskip("pybullet_envs_gymnasium")

from torchrl_tsallis.envs import ENV_ID, make_ant, register_ant  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore")


def rollout(env, seed, steps=120):
    """Two episodes of seeded actions; the second one goes on with the env's generator."""
    rng = np.random.default_rng(seed)
    record = []
    for episode in range(2):
        obs, _ = env.reset(seed=seed if episode == 0 else None)
        record.append((obs, 0.0, False, False))
        action = np.zeros(8, dtype=np.float32)
        for step in range(steps):
            if step % (1 + 4 * episode) == 0:
                action = rng.uniform(-1.2, 1.2, 8).astype(np.float32)
            obs, reward, terminated, truncated, _ = env.step(action)
            record.append((obs, float(reward), bool(terminated), bool(truncated)))
            if terminated or truncated:
                break
    return record


def assert_same(a, b):
    assert len(a) == len(b)
    for x, y in zip(a, b, strict=True):
        assert x[0].dtype == y[0].dtype == np.float32
        np.testing.assert_array_equal(x[0], y[0])
        assert x[1:] == y[1:]


def test_equals_package():
    env, package = make_ant(), gym.make("AntBulletEnv-v0")
    try:
        assert env.observation_space == package.observation_space
        assert env.action_space == package.action_space
        assert_same(rollout(env, 3), rollout(package, 3))
    finally:
        env.close()
        package.close()


def test_reset_after_close():
    env = make_ant()
    first = rollout(env, 5, steps=20)
    env.close()
    env.close()
    assert_same(first, rollout(env, 5, steps=20))
    env.close()


def test_truncates():
    env = make_ant()
    assert env.spec.max_episode_steps == 1000
    assert env.spec.id == ENV_ID
    register_ant()
    env.close()


def test_quiet(capfd):
    env = make_ant()
    env.reset(seed=0)
    env.close()
    out, err = capfd.readouterr()
    assert out == "" and err == ""


def test_checker():
    from gymnasium.utils.env_checker import check_env

    env = make_ant()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_image():
    env = make_ant(render_mode="rgb_array")
    env.reset(seed=0)
    image = env.render()
    assert image.shape == (240, 320, 3) and image.dtype == np.uint8
    env.close()
