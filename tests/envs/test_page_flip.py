from __future__ import annotations

import math
import warnings

import numpy as np
import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("pybullet")

from torchrl_tsallis.data.teleoperation import FlipOperator, Style  # noqa: E402
from torchrl_tsallis.envs import PAGE_FLIP_ID, count_flips, make_page_flip  # noqa: E402
from torchrl_tsallis.envs import _arm as arm  # noqa: E402
from torchrl_tsallis.envs._flip_world import FlipWorld, limit_force  # noqa: E402
from torchrl_tsallis.envs._notebook import PAGES, page_torques  # noqa: E402

STEADY = Style(misses=0.0, releases=0.0, hesitates=0.0, height_noise=0.0, tremor=0.0, wander=0.0)


@pytest.fixture
def env():
    env = make_page_flip()
    yield env
    env.close()


@pytest.fixture
def world():
    world = FlipWorld()
    yield world
    world.close()


def pull(env, target, steps, observation):
    """Pulls the tip towards a point by a spring."""
    for _ in range(steps):
        force = 120.0 * (np.asarray(target) - observation[:3])
        observation, _, _, _, info = env.step(force.astype(np.float32))
    return observation, info


def operate(env, seed, steps, style=STEADY):
    observation, info = env.reset(seed=seed)
    operator = FlipOperator(seed, style)
    rows = []
    for _ in range(steps):
        action = operator.act(observation, info["edges"])
        observation, reward, terminated, truncated, info = env.step(action)
        rows.append((action, observation, reward, info))
        assert not terminated
        if truncated:
            break
    return rows


@pytest.mark.parametrize("flipped", [0, 6])
def test_pages_come_to_rest(world, flipped):
    world.notebook.lay(flipped)
    world._advance(np.zeros(3), 700)
    assert np.abs(world.notebook.rates).max() < 0.1
    assert (world.notebook.edge_angles > 2.9).sum() == flipped


def test_every_link_has_inertia(world):
    for body in (world.notebook.body, world.arm.body):
        for joint in range(world.client.getNumJoints(body)):
            assert min(world.client.getDynamicsInfo(body, joint)[2]) > 1e-8


def test_the_apparent_mass_at_the_tip_is_that_of_the_touch(world):
    masses = []
    for x, z in ((0.1, 0.02), (0.05, 0.06), (0.0, 0.085), (-0.03, 0.075)):
        angles = arm.inverse_kinematics(np.array([x, 0.0, z]))
        joint_space = np.array(world.client.calculateMassMatrix(world.arm.body, angles.tolist()))
        matrix = arm.jacobian(angles)
        masses.append(np.linalg.inv(matrix @ np.linalg.inv(joint_space) @ matrix.T).trace() / 3)
    assert np.mean(masses) == pytest.approx(0.045, abs=0.003)


def test_kinematics_agree_with_bullet_and_the_jacobian_with_differences(world):
    point = np.array([0.07, 0.02, 0.05])
    world.arm.place(point)
    np.testing.assert_allclose(world.arm.position, point, atol=1e-9)
    frame, turn = world.client.getLinkState(world.arm.body, 2, computeForwardKinematics=1)[4:6]
    tip, _ = world.client.multiplyTransforms(frame, turn, (arm.LINK, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    np.testing.assert_allclose(tip, point, atol=1e-6)
    angles = world.arm.angles
    for i, step in enumerate(1e-6 * np.eye(3)):
        slope = (arm.forward_kinematics(angles + step) - arm.forward_kinematics(angles - step)) / 2e-6
        np.testing.assert_allclose(arm.jacobian(angles)[:, i], slope, atol=1e-8)
    with pytest.raises(ValueError, match="the arm reaches"):
        arm.inverse_kinematics(np.array([1.0, 0.0, 0.0]))


def test_the_unloaded_arm_stays_and_answers_a_force_above_its_friction(world):
    world.arm.place(np.array([0.1, 0.0, 0.1]))
    start = world.arm.position
    for _ in range(25):
        world.step(np.zeros(3))
    assert np.abs(world.arm.position - start).max() < 1e-3
    for _ in range(25):
        world.step(np.array([0.0, 0.1, 0.0]))  # below the dry friction
    assert np.abs(world.arm.position - start).max() < 1e-3
    for _ in range(25):
        world.step(np.array([0.0, 0.5, 0.0]))
    assert world.arm.position[1] > 0.03


def test_springs_between_pages_push_apart():
    angles = np.zeros((PAGES, 3))
    angles[:, 0] = np.linspace(0.1, 3.0, PAGES)
    angles[4, 0] = angles[5, 0] - 0.001
    torques = page_torques(angles, np.zeros_like(angles))
    assert torques[4, 0] < 0 < torques[5, 0]
    assert np.abs(np.delete(torques, (4, 5), 0)).max() == 0
    np.testing.assert_allclose(torques[4] + torques[5], 0, atol=1e-5)


def test_the_force_is_limited(env):
    observation, _ = env.reset(seed=0)
    observation, *_ = env.step(np.array([100.0, 0.0, 100.0], dtype=np.float32))
    assert np.linalg.norm(observation[3:6]) == pytest.approx(arm.FORCE_LIMIT, rel=1e-6)
    assert env.observation_space.contains(observation)
    assert limit_force(np.array([1.0, 2.0, 0.5])).tolist() == [1.0, 2.0, 0.5]
    with pytest.raises(ValueError, match="not finite"):
        env.step(np.full(3, np.nan, dtype=np.float32))


def test_observation_is_now_and_one_step_before(env):
    first, _ = env.reset(seed=0)
    assert first.shape == (12,) and first.dtype == np.float32
    np.testing.assert_array_equal(first[:6], first[6:])
    action = np.array([0.3, -0.2, 1.0], dtype=np.float32)
    second, *_ = env.step(action)
    np.testing.assert_array_equal(second[6:], first[:6])
    np.testing.assert_array_equal(second[3:6], action)


def test_one_stroke_turns_exactly_one_page(env):
    rows = operate(env, 3, 160)
    flips = count_flips(env.unwrapped.angle_history)
    assert flips.pages.tolist() == [PAGES - 1]
    assert sum(row[2] for row in rows) == flips.total == rows[-1][3]["flips"]
    touched = [np.linalg.norm(row[3]["contact_force"]) > 0.02 for row in rows]
    assert 10 < sum(touched) < 120  # it moves by contact
    before = [row[3]["hinge_angles"][-1] for row in rows[: touched.index(True)]]
    assert np.ptp(before) < 0.02  # and not before it


def test_a_stroke_above_the_page_turns_none(env):
    operate(env, 3, 160, Style(**{**vars(STEADY), "height_bias": 0.008}))
    assert count_flips(env.unwrapped.angle_history).total == 0
    assert env.unwrapped.angle_history.max() < 1.0


def test_pressing_hard_turns_none_and_is_stopped(env):
    observation, info = env.reset(seed=0)
    observation, _ = pull(env, (0.07, 0.0, 0.05), 30, observation)
    for step in range(150):
        sweep = -1.0 if step > 50 else 0.0
        observation, _, _, _, info = env.step(np.array([sweep, 0.0, -3.0], dtype=np.float32))
    assert info["flips"] == 0
    assert info["contact_force"][2] > 1.5  # the notebook holds against it
    assert observation[2] > 0.0
    assert np.linalg.norm(observation[:3] - observation[6:9]) < 1e-3  # stuck


def test_same_seed_and_forces_same_trial_also_in_a_fresh_client():
    def run(env):
        rows = operate(env, 11, 150, Style())
        return np.stack([row[1] for row in rows]), env.unwrapped.angle_history

    first, fresh = make_page_flip(), make_page_flip()
    expected = run(first)
    operate(first, 4, 60)  # another trial between
    for env in (first, fresh):
        for a, b in zip(run(env), expected, strict=True):
            np.testing.assert_array_equal(a, b)
        env.close()
    assert not np.array_equal(first.reset(seed=12)[0], first.reset(seed=11)[0])  # also after close
    first.close()


def test_truncates_and_is_registered(env):
    assert env.spec.id == PAGE_FLIP_ID and env.spec.max_episode_steps == 500
    with pytest.raises(RuntimeError, match="call reset"):
        env.unwrapped.step(np.zeros(3, dtype=np.float32))


def test_checker():
    from gymnasium.utils.env_checker import check_env

    env = make_page_flip("rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*symmetric and normalized space")  # actions are forces in N
        check_env(env.unwrapped, skip_render_check=False)
    env.close()


def test_image_and_silence(capfd):
    env = make_page_flip("rgb_array")
    env.reset(seed=0)
    image = env.render()
    assert image.shape == (320, 480, 3) and image.dtype == np.uint8
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 50
    env.close()
    env.close()
    out, err = capfd.readouterr()
    assert out == "" and err == ""
    with pytest.raises(ValueError, match="render_mode"):
        make_page_flip("human")


@pytest.mark.slow
def test_a_steady_hand_flips_page_after_page(env):
    rows = operate(env, 5, 500, Style())
    flips = count_flips(env.unwrapped.angle_history)
    assert len(rows) == 500
    assert 2 <= flips.total <= PAGES
    assert flips.pages.max() == PAGES - 1
    edges = rows[-1][3]["edges"]
    assert np.isfinite(edges).all() and np.hypot(*edges.T).max() < 0.106
    assert math.isclose(sum(row[2] for row in rows), flips.total)
