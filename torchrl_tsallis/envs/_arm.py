"""A desktop haptic arm after the 3D Systems Touch, for PyBullet.

Yaw, shoulder and elbow turn two links of equal length. The base stands to the right of the notebook (+x) and reaches
over it (-x). Forces and positions are those of the ball at the tip, in the world's frame, N and m.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

FORCE_LIMIT = 3.3  # N, largest force at the tip (data sheet)
LINK = 0.1335  # m
SHOULDER = (0.18, 0.0, 0.12)  # m
RADIUS = 0.005  # m, of the ball
HOOK = (0.1235, -0.045)  # m, bend of the forearm, whose end reaches under a page from the side
MASSES = (0.010, 0.015, 0.030)  # kg: upper arm, forearm, ball; about 45 g at the tip (data sheet)
FRICTION = 0.15  # N an axis, dry; 0.26 N in all (data sheet: backdrive friction)
DRAG = 1.5  # N s/m, viscous
TIP_FRICTION = 0.9
GRAVITY = 9.81  # m/s^2


def _link(name: str, mass: float, inertia: tuple[float, float, float], x: float, visuals: str, extra: str = "") -> str:
    """One link whose mass is centred at x on its own axis."""
    ixx, iyy, izz = inertia
    return (
        f'<link name="{name}">\n<inertial>\n<origin xyz="{x} 0 0"/>\n<mass value="{mass}"/>\n'
        f'<inertia ixx="{ixx:.9g}" ixy="0" ixz="0" iyy="{iyy:.9g}" iyz="0" izz="{izz:.9g}"/>\n</inertial>\n'
        f"{visuals}{extra}</link>\n"
    )


def _bar(start: tuple[float, float], end: tuple[float, float], radius: float) -> str:
    """A rod to see, between two points (x, z) of a link."""
    dx, dz = end[0] - start[0], end[1] - start[1]
    return (
        f'<visual>\n<origin xyz="{start[0] + dx / 2} 0 {start[1] + dz / 2}" rpy="0 {math.atan2(dx, dz)} 0"/>\n'
        f'<geometry>\n<cylinder radius="{radius}" length="{math.hypot(dx, dz)}"/>\n</geometry>\n</visual>\n'
    )


def _joint(name: str, parent: str, x: float, axis: str, limits: tuple[float, float]) -> str:
    """A revolute joint."""
    return (
        f'<joint name="{name}" type="revolute">\n<parent link="{parent}"/>\n<child link="{name}"/>\n'
        f'<origin xyz="{x} 0 0"/>\n<axis xyz="{axis}"/>\n'
        f'<limit lower="{limits[0]}" upper="{limits[1]}" effort="100" velocity="100"/>\n'
        '<dynamics damping="0.0001" friction="0"/>\n</joint>\n'
    )


def arm_urdf() -> str:
    """The arm; only the ball at its tip collides, the links are drawn.

    Examples:
        >>> arm_urdf().count("<joint")
        3
    """
    upper, fore, ball = MASSES
    sphere = f'<origin xyz="{LINK} 0 0"/>\n<geometry>\n<sphere radius="{RADIUS}"/>\n</geometry>\n'
    # Forearm and ball are one link: centre and inertia of both together.
    mass = fore + ball
    centre = (fore / 2 + ball) * LINK / mass
    about = fore * LINK**2 / 12 + fore * (centre - LINK / 2) ** 2 + ball * (LINK - centre) ** 2
    column = (
        f'<visual>\n<origin xyz="0 0 {-SHOULDER[2] / 2}"/>\n<geometry>\n'
        f'<cylinder radius="0.016" length="{SHOULDER[2] - 0.012}"/>\n</geometry>\n</visual>\n'
    )
    return "".join(
        [
            '<?xml version="1.0"?>\n<robot name="arm">\n',
            _link("base", 1.0, (0.01, 0.01, 0.01), 0.0, column),
            _link("yaw", 0.02, (4e-6, 4e-6, 4e-6), 0.0, ""),
            _link(
                "shoulder",
                upper,
                (2e-7, upper * LINK**2 / 12, upper * LINK**2 / 12),
                LINK / 2,
                _bar((0, 0), (LINK, 0), 0.006),
            ),
            _link(
                "elbow",
                mass,
                (6e-7, about, about),
                centre,
                _bar((0, 0), HOOK, 0.003) + _bar(HOOK, (LINK, 0), 0.002) + f"<visual>\n{sphere}</visual>\n",
                f"<collision>\n{sphere}</collision>\n",
            ),
            _joint("yaw", "base", 0.0, "0 0 1", (-1.3, 1.3)),
            _joint("shoulder", "yaw", 0.0, "0 -1 0", (-0.6, 2.2)),
            _joint("elbow", "shoulder", LINK, "0 -1 0", (-2.7, -0.4)),
            "</robot>\n",
        ]
    )


class Arm:
    """The arm in a physics client: driven by a force at its tip, its own weight balanced.

    The drives' losses act at the tip, as data sheets state them: dry friction in the joints and viscous drag.

    Args:
        client: PyBullet client.
        path: file with :func:`arm_urdf`.
    """

    def __init__(self, client: Any, path: str) -> None:
        self._client = client
        turned = client.getQuaternionFromEuler((0.0, 0.0, math.pi))  # the links' +x is the world's -x
        self.body = client.loadURDF(path, SHOULDER, turned, useFixedBase=True, flags=client.URDF_USE_INERTIA_FROM_FILE)
        self.joints = [0, 1, 2]
        for joint in self.joints:
            client.changeDynamics(
                self.body, joint, lateralFriction=TIP_FRICTION, restitution=0.0, linearDamping=0.0, angularDamping=0.0
            )
            client.changeVisualShape(
                self.body, joint, rgbaColor=(0.25, 0.25, 0.28, 1.0) if joint < 2 else (0.85, 0.2, 0.1, 1.0)
            )
        client.changeVisualShape(self.body, -1, rgbaColor=(0.25, 0.25, 0.28, 1.0))
        client.setJointMotorControlArray(
            self.body,
            self.joints,
            client.VELOCITY_CONTROL,
            targetVelocities=[0.0] * 3,
            forces=[FRICTION * LINK] * 3,
        )
        self.angles, self.rates = np.zeros(3), np.zeros(3)
        self.read()

    def read(self) -> None:
        """Reads the joints' angles in rad and rates in rad/s."""
        both = np.array([state[:2] for state in self._client.getJointStates(self.body, self.joints)])
        self.angles, self.rates = both[:, 0], both[:, 1]

    def place(self, position: np.ndarray) -> None:
        """Puts the ball's centre at a position ``[3]`` in m, at rest."""
        for joint, angle in zip(self.joints, inverse_kinematics(position), strict=True):
            self._client.resetJointState(self.body, joint, float(angle), 0.0)
        self.read()

    @property
    def position(self) -> np.ndarray:
        """Position of the ball's centre, ``[3]`` in m."""
        return forward_kinematics(self.angles)

    @property
    def velocity(self) -> np.ndarray:
        """Velocity of the ball's centre, ``[3]`` in m/s."""
        return jacobian(self.angles) @ self.rates

    def apply_force(self, force: np.ndarray) -> None:
        """Exerts a force ``[3]`` in N at the tip during the next physics step."""
        self.read()
        matrix = jacobian(self.angles)
        torques = matrix.T @ (force - DRAG * (matrix @ self.rates)) + weight_torques(self.angles)
        self._client.setJointMotorControlArray(
            self.body, self.joints, self._client.TORQUE_CONTROL, forces=torques.tolist()
        )


def forward_kinematics(angles: np.ndarray) -> np.ndarray:
    """Position of the tip, ``[3]`` in m, for yaw, shoulder and elbow in rad.

    Examples:
        >>> forward_kinematics(np.array([0.0, np.pi / 2, -np.pi / 2])).round(4)
        array([0.0465, 0.    , 0.2535])
    """
    yaw, first, second = angles[0], angles[1], angles[1] + angles[2]
    reach = LINK * (math.cos(first) + math.cos(second))
    height = LINK * (math.sin(first) + math.sin(second))
    return np.array([SHOULDER[0] - reach * math.cos(yaw), SHOULDER[1] - reach * math.sin(yaw), SHOULDER[2] + height])


def jacobian(angles: np.ndarray) -> np.ndarray:
    """Derivative of the tip's position by the angles, ``[3, 3]`` in m/rad."""
    yaw, first, second = angles[0], angles[1], angles[1] + angles[2]
    c, s = math.cos(yaw), math.sin(yaw)
    reach = LINK * (math.cos(first) + math.cos(second))
    reach_1 = -LINK * (math.sin(first) + math.sin(second))
    reach_2 = -LINK * math.sin(second)
    return np.array(
        [
            [reach * s, -reach_1 * c, -reach_2 * c],
            [-reach * c, -reach_1 * s, -reach_2 * s],
            [0.0, reach, LINK * math.cos(second)],
        ]
    )


def inverse_kinematics(position: np.ndarray) -> np.ndarray:
    """Angles ``[3]`` with the elbow up for a position of the tip, ``[3]`` in m.

    Raises:
        ValueError: if the arm cannot reach it.

    Examples:
        >>> point = np.array([0.05, 0.02, 0.03])
        >>> np.allclose(forward_kinematics(inverse_kinematics(point)), point)
        True
    """
    x, y, z = np.asarray(SHOULDER) - position
    reach, distance = math.hypot(x, y), math.sqrt(x * x + y * y + z * z)
    if not 0 < distance < 2 * LINK:
        raise ValueError(f"the arm reaches {2 * LINK} m from {SHOULDER}, not to {np.round(position, 3).tolist()}")
    half = math.acos(distance / (2 * LINK))  # between each link and the line from shoulder to tip
    first = math.atan2(-z, reach) + half
    return np.array([math.atan2(y, x), first, -2 * half])


def weight_torques(angles: np.ndarray) -> np.ndarray:
    """Torques ``[3]`` in N m that balance the links' weight."""
    upper, fore, ball = MASSES
    first, second = math.cos(angles[1]), math.cos(angles[1] + angles[2])
    elbow = GRAVITY * LINK * (fore / 2 + ball) * second
    shoulder = GRAVITY * LINK * (upper / 2 + fore + ball) * first + elbow
    return np.array([0.0, shoulder, elbow])
