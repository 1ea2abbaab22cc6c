"""The Ant on PyBullet, with few and batched calls of the physics.

It equals ``AntBulletEnv-v0`` of ``pybullet_envs_gymnasium`` bit for bit, which
takes care in odd places: each of them has a comment that says why. That
environment asks PyBullet for every link, joint and foot on its own, in dozens of
calls a step; here there are 8. Robot and floor are the files of ``pybullet_data``.
"""

from __future__ import annotations

import math
import os
import time
import weakref
from typing import Any

import gymnasium
import numpy as np

from torchrl_tsallis.envs._quiet import quiet

with quiet():
    import pybullet as p
    import pybullet_data

STEP = 0.0165  # s of simulated time a step
SUBSTEPS = 4
TORQUE = 2.5 * 100.0  # N m at action 1: the robot's power times the joints' coefficient
GOAL = 1e3  # m: the robot walks towards (GOAL, 0)
FALLEN = 0.26  # m: lowest height of the torso's centre; 0.25 is its radius
START = 0.1  # rad: the joints' initial angles are uniform within it
FEET = ("front_left_foot", "front_right_foot", "left_back_foot", "right_back_foot")
NEAR_LIMIT = float(np.float32(0.99))  # of a scaled angle
ELECTRICITY_COST, STALL_COST, LIMIT_COST = -2.0, -0.1, -0.1
_sum = np.add.reduce


def _mean(v: tuple[float, ...]) -> float:
    """NumPy's mean of 21 or 22 numbers: its pairwise order of summation, three times as fast as making an array."""
    total = ((v[0] + v[8]) + (v[1] + v[9])) + ((v[2] + v[10]) + (v[3] + v[11]))
    total += ((v[4] + v[12]) + (v[5] + v[13])) + ((v[6] + v[14]) + (v[7] + v[15]))
    total = total + v[16] + v[17] + v[18] + v[19] + v[20]
    return (total + v[21]) / 22 if len(v) == 22 else total / 21


class AntEnv(gymnasium.Env):
    """A four-legged robot that is rewarded for walking along x.

    **Observation**, ``[28]`` float32, clipped to [-5, 5]: height of the torso over the initial one (m), sine and cosine
    of the angle to the target, 0.3 x velocity in the heading's frame (m/s, 3), roll and pitch (rad), for each of the 8
    joints its angle (scaled so that the limits are -1 and 1) and 0.1 x its speed (rad/s), and for each of the 4 feet
    whether it touched the floor after the *previous* step.

    **Action**, ``[8]``: torques in units of 250 N m, clipped to [-1, 1].

    **Reward**: 1 when alive or -1 when fallen, + progress (m/s), - 2 x mean(abs(action x scaled speed)) - 0.1 x
    mean(action ** 2) - 0.1 x number of joints at their limits. The costs are those of the unclipped action.

    The first episode after construction or :meth:`close` differs from later ones: its first reward is off by a jump of
    some m/s, because the floor joins the parts whose mean is the position only after the first reset.

    Args:
        render_mode: ``None``, ``"rgb_array"`` (an image ``[240, 320, 3]``, uint8) or ``"human"`` (a window).

    Examples:
        >>> env = AntEnv()
        >>> observation, _ = env.reset(seed=0)
        >>> observation.shape, env.step(np.zeros(8, dtype=np.float32))[0].shape
        ((28,), (28,))
        >>> env.close()
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 60}

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (8,), np.float32)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (28,), np.float32)
        self._render_width, self._render_height = 320, 240
        self._disconnect: Any = None
        self._state = -1
        self._parts_of_floor: list[tuple[float, float, float]] = []
        self._turn = np.eye(3)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode with random joint angles; without a seed the generator goes on.

        Args:
            seed: of the generator.
            options: not used.

        Returns:
            The observation ``[28]`` and an empty dictionary.
        """
        super().reset(seed=seed)
        if first := self._disconnect is None:
            with quiet():
                self._load()
        else:
            p.restoreState(self._state, physicsClientId=self._client)
            self._set_engine()
        angles = self.np_random.uniform(-START, START, len(self._joints)).tolist()
        for joint, angle in zip(self._joints, angles, strict=True):
            p.resetJointState(self._ant, joint, angle, 0, physicsClientId=self._client)
        self._motors_off(self._joints)
        self._feet = [0.0] * len(FEET)
        self._initial_z = p.getBasePositionAndOrientation(self._ant, physicsClientId=self._client)[0][2]
        observation = np.clip(self._observe(), -5, 5)
        if first:
            # The state to return to is saved after the joints were moved, and the
            # floor counts as a part of the robot from here on.
            self._parts_of_floor = [p.getBasePositionAndOrientation(self._floor, physicsClientId=self._client)[0]]
            self._state = p.saveState(physicsClientId=self._client)
        return observation, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Apply torques for 0.0165 s.

        Args:
            action: ``[8]``, any float dtype.

        Returns:
            Observation ``[28]``, reward, whether the robot fell, ``False`` (the time limit is a wrapper's) and an empty
            dictionary.

        Raises:
            gymnasium.error.ResetNeeded: if there is no episode.
            ValueError: if the action is not finite.
        """
        if self._disconnect is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        action = np.asarray(action)
        torques = action.tolist()
        if not math.isfinite(sum(torques)):
            raise ValueError(f"the action must be finite, got {action}")
        torques = [TORQUE * (-1.0 if a < -1.0 else 1.0 if a > 1.0 else a) for a in torques]
        client, ant = self._client, self._ant
        p.setJointMotorControlArray(ant, self._joints, p.TORQUE_CONTROL, forces=torques, physicsClientId=client)
        p.stepSimulation(physicsClientId=client)
        before = self._potential
        raw = self._observe()  # a new array, which may be handed out
        # One product finds both what must be clipped (|x| > 5) and a NaN, which fails every comparison.
        size = raw.dot(raw)
        observation = raw if size < 25 else np.clip(raw, -5, 5)
        # The height passes through float32 in the observation.
        alive = 1.0 if float(observation[0]) + self._initial_z > FALLEN else -1.0
        terminated = alive < 0 or bool(size != size)
        touching = {contact[3] for contact in p.getContactPoints(ant, self._floor, -2, -1, physicsClientId=client)}
        self._feet = [float(foot in touching) for foot in self._foot_links]
        # All in the dtype of action and observation, float32 as a rule; the reductions
        # over 8 are means, without the overhead of ndarray.mean.
        cost = ELECTRICITY_COST * float(_sum(np.abs(action * raw[9:24:2])) / 8)
        cost += STALL_COST * float(_sum(np.square(action)) / 8)
        limits = LIMIT_COST * sum([abs(angle) > NEAR_LIMIT for angle in raw[8:24:2].tolist()])
        # sum() because Python 3.12's compensates rounding, unlike a chain of +.
        reward = sum((alive, self._potential - before, cost, limits))
        return observation, reward, terminated, False, {}

    def _observe(self) -> np.ndarray:
        """Read the physics: the observation ``[28]`` before it is clipped; also updates the potential."""
        client, ant = self._client, self._ant
        position, orientation = p.getBasePositionAndOrientation(ant, physicsClientId=client)
        velocity = p.getBaseVelocity(ant, physicsClientId=client)[0]
        roll, pitch, yaw = p.getEulerFromQuaternion(orientation)
        parts = [link[0] for link in p.getLinkStates(ant, self._links, physicsClientId=client)]
        # The order of the parts, and of y and x, decides how the sums are rounded.
        parts[1:1] = (position,)
        parts += self._parts_of_floor
        x, y, _ = zip(*parts)  # noqa: B905
        gap = np.array((0.0 - _mean(y), GOAL - _mean(x)))
        # A dot product and NumPy's trigonometry, not math's, round like the package's.
        self._potential = -math.sqrt(gap.dot(gap)) / STEP
        dy, dx = gap
        angle = np.arctan2(dy, dx) - yaw
        turn = self._turn
        turn[0, 0] = turn[1, 1] = np.cos(-yaw)
        turn[1, 0] = sin = np.sin(-yaw)
        turn[0, 1] = -sin
        vx, vy, vz = turn.dot(velocity).tolist()
        height = position[2] - self._initial_z
        values = [height, np.sin(angle), np.cos(angle), 0.3 * vx, 0.3 * vy, 0.3 * vz, roll, pitch]
        states = p.getJointStates(ant, self._joints, physicsClientId=client)
        for (lower, span), (at, speed, _, _) in zip(self._limits, states, strict=True):
            values += (2 * (at - lower) / span - 1.0, 0.1 * speed)
        values += self._feet
        self._position = position
        return np.array(values, dtype=np.float32)

    def _load(self) -> None:
        """Connect to the physics and load floor and robot."""
        self._client = client = p.connect(p.GUI if self.render_mode == "human" else p.DIRECT)
        self._disconnect = weakref.finalize(self, p.disconnect, client)
        self._parts_of_floor = []
        p.resetSimulation(physicsClientId=client)
        p.setPhysicsEngineParameter(deterministicOverlappingPairs=1, physicsClientId=client)
        p.configureDebugVisualizer(p.COV_ENABLE_GUI, 0, physicsClientId=client)
        self._set_engine()
        data = pybullet_data.getDataPath()
        (self._floor,) = p.loadSDF(os.path.join(data, "plane_stadium.sdf"), physicsClientId=client)
        p.changeDynamics(self._floor, -1, lateralFriction=0.8, restitution=0.5, physicsClientId=client)
        p.changeVisualShape(self._floor, -1, rgbaColor=[1, 1, 1, 0.8], physicsClientId=client)
        flags = p.URDF_USE_SELF_COLLISION | p.URDF_USE_SELF_COLLISION_EXCLUDE_ALL_PARENTS
        flags |= p.URDF_GOOGLEY_UNDEFINED_COLORS
        (self._ant,) = p.loadMJCF(os.path.join(data, "mjcf", "ant.xml"), flags=flags, physicsClientId=client)
        self._links = list(range(p.getNumJoints(self._ant, physicsClientId=client)))
        infos = [p.getJointInfo(self._ant, link, physicsClientId=client) for link in self._links]
        self._joints = [info[0] for info in infos if info[2] == p.JOINT_REVOLUTE]
        self._limits = [(infos[j][8], infos[j][9] - infos[j][8]) for j in self._joints]
        names = [info[12].decode() for info in infos]
        self._foot_links = [names.index(foot) for foot in FEET]
        self._motors_off(self._links)

    def _set_engine(self) -> None:
        """Set gravity (m/s^2) and the solver; the package does so at every reset."""
        p.setGravity(0, 0, -9.8, physicsClientId=self._client)
        p.setDefaultContactERP(0.9, physicsClientId=self._client)
        p.setPhysicsEngineParameter(
            fixedTimeStep=STEP, numSolverIterations=5, numSubSteps=SUBSTEPS, physicsClientId=self._client
        )

    def _motors_off(self, joints: list[int]) -> None:
        """Turn off PyBullet's motors, which hold every joint by default."""
        count = len(joints)
        gains = {"positionGains": [0.1] * count, "velocityGains": [0.1] * count, "forces": [0.0] * count}
        p.setJointMotorControlArray(self._ant, joints, p.POSITION_CONTROL, **gains, physicsClientId=self._client)

    def render(self) -> np.ndarray | None:
        """Draw the robot: an image ``[height, width, 3]`` of uint8, or the window's next frame."""
        if self._disconnect is None:
            raise gymnasium.error.ResetNeeded("call reset before render")
        if self.render_mode == "human":
            p.resetDebugVisualizerCamera(3, 0, -30, self._position, physicsClientId=self._client)  # m, degrees
            time.sleep(1 / self.metadata["render_fps"])
        if self.render_mode != "rgb_array":
            return None
        view = p.computeViewMatrixFromYawPitchRoll(self._position, distance=3, yaw=0, pitch=-30, roll=0, upAxisIndex=2)
        width, height = self._render_width, self._render_height
        lens = p.computeProjectionMatrixFOV(fov=60, aspect=width / height, nearVal=0.1, farVal=100.0)
        image = p.getCameraImage(width, height, view, lens, physicsClientId=self._client)[2]
        return np.array(image, dtype=np.uint8).reshape(height, width, -1)[..., :3]

    def close(self) -> None:
        """Disconnect from the physics; a later reset connects anew."""
        if self._disconnect is not None:
            self._disconnect()
            self._disconnect = None
