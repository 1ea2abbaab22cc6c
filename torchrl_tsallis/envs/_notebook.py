"""A ring-bound notebook of thin pages that bend, for PyBullet.

Frame: the ring is the y axis of the world; closed pages lie along +x, flipped ones along -x; z points up. Angles are
measured about the ring from +x over +z, in rad. Lengths are in m, forces in N.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

PAGES = 10
SEGMENTS = 3  # rigid strips a page, joined by springs
LENGTH = 0.035  # m, of a segment away from the ring; a page is 105 mm x 148 mm (A6)
WIDTH = 0.148  # m, of a page along the ring
THICKNESS = 0.0006  # m
MASS = 0.001  # kg a segment
ADDED_INERTIA = 2.0  # inertia over a bare strip's: the air that moves along; also keeps the springs stable
SPREAD = 0.003  # rad between neighbours' hinge stops: the pages' places on the ring
MARGIN = 0.02  # rad between the covers and the outer stops
BEND_LIMIT = 1.2  # rad
BEND_DAMPING, HINGE_DAMPING = 5e-5, 1.5e-4  # N m s/rad
# Page against page, per segment's end: a hard unilateral spring on contact, and a soft one that fans the pages out
HARD_GAP, HARD_STIFFNESS, HARD_DAMPING, HARD_MAX = 0.8 * SPREAD, 10.0, 0.02, 0.5  # rad, N/m, N s/m, N
SOFT_GAP, SOFT_STIFFNESS, SOFT_DAMPING, SOFT_MAX = 0.035, 3.0, 0.01, 0.1  # rad, N/m, N s/m, N
FRICTION = 0.6
COLOURS = ((0.96, 0.94, 0.86, 1.0), (0.45, 0.66, 0.86, 1.0))


def _inertial(mass: float, x: float, size: tuple[float, float, float], scale: float = 1.0) -> str:
    """A box's inertia, kept strictly physical: Bullet sets tensors with Ixx + Iyy <= Izz to zero."""
    xx, yy = (scale * mass / 12 * (size[a] ** 2 + size[2] ** 2) for a in (1, 0))
    return (
        f'<inertial>\n<origin xyz="{x} 0 0"/>\n<mass value="{mass}"/>\n'
        f'<inertia ixx="{xx:.9g}" ixy="0" ixz="0" iyy="{yy:.9g}" iyz="0" izz="{0.99 * (xx + yy):.9g}"/>\n</inertial>\n'
    )


def _shapes(x: float, z: float, size: tuple[float, float, float]) -> str:
    """A box to collide with and to see."""
    shape = f'<origin xyz="{x} 0 {z}"/>\n<geometry>\n<box size="{size[0]} {size[1]} {size[2]}"/>\n</geometry>\n'
    return f"<visual>\n{shape}</visual>\n<collision>\n{shape}</collision>\n"


def notebook_urdf() -> str:
    """The notebook as one multibody: a base and pages x segments revolute joints.

    The base is a desk, on which the flipped pages' edges rest, and on its right a block for the sheets that stay, 6 mm
    high up to the ring. The page of index 0 lies at the bottom of the closed stack. Lines are broken, because Bullet's
    parser needs it.

    Examples:
        >>> notebook_urdf().count("<joint")
        30
    """
    parts = ['<?xml version="1.0"?>\n<robot name="notebook">\n<link name="base">\n']
    parts += [_inertial(1.0, 0.0, (1.0, 1.0, 0.01))]
    parts += [_shapes(0.054, -0.003, (0.108, 0.15, 0.006)), _shapes(0.0, -0.016, (0.8, 0.8, 0.02)), "</link>\n"]
    strip = (LENGTH, WIDTH, THICKNESS)
    for page in range(PAGES):
        low, high = MARGIN + page * SPREAD, math.pi - MARGIN - (PAGES - 1 - page) * SPREAD
        for segment in range(SEGMENTS):
            name, parent = f"page{page}_{segment}", f"page{page}_{segment - 1}" if segment else "base"
            lower, upper = (-BEND_LIMIT, BEND_LIMIT) if segment else (low, high)
            damping = BEND_DAMPING if segment else HINGE_DAMPING
            parts += [
                f'<link name="{name}">\n',
                _inertial(MASS, LENGTH / 2, strip, ADDED_INERTIA),
                _shapes(LENGTH / 2, 0.0, strip),
                f'</link>\n<joint name="{name}" type="revolute">\n<parent link="{parent}"/>\n<child link="{name}"/>\n',
                f'<origin xyz="{LENGTH if segment else 0} 0 0"/>\n<axis xyz="0 -1 0"/>\n',
                f'<limit lower="{lower:.6f}" upper="{upper:.6f}" effort="100" velocity="1000"/>\n',
                f'<dynamics damping="{damping}" friction="0"/>\n</joint>\n',
            ]
    return "".join([*parts, "</robot>\n"])


class Notebook:
    """The notebook in a physics client.

    Bullet computes the joints, the stops, gravity and the contact with the tip. The forces between pages are unilateral
    springs between neighbours, computed here: Bullet's own contact of ten stacked strips explodes at 500 Hz.

    Args:
        client: PyBullet client, e.g. of ``pybullet_utils.bullet_client``.
        path: file with :func:`notebook_urdf`.
    """

    def __init__(self, client: Any, path: str) -> None:
        self._client = client
        self.body = client.loadURDF(path, useFixedBase=True, flags=client.URDF_USE_INERTIA_FROM_FILE)
        self.joints = list(range(PAGES * SEGMENTS))
        for joint in self.joints:
            client.setJointMotorControl2(self.body, joint, client.VELOCITY_CONTROL, force=0.0)
            client.changeDynamics(
                self.body, joint, lateralFriction=FRICTION, restitution=0.0, linearDamping=0.0, angularDamping=0.0
            )
            client.changeVisualShape(self.body, joint, rgbaColor=COLOURS[joint // SEGMENTS % 2])
        client.changeDynamics(self.body, -1, lateralFriction=FRICTION, restitution=0.0)
        for shape, colour in enumerate(((0.35, 0.27, 0.22, 1.0), (0.78, 0.72, 0.64, 1.0))):
            client.changeVisualShape(self.body, -1, shapeIndex=shape, rgbaColor=colour)
        self.curl = 0.1  # rad, rest angle of a bend
        self.stiffness = 0.01  # N m/rad, of a bend
        self.angles = np.zeros((PAGES, SEGMENTS))
        self.rates = np.zeros((PAGES, SEGMENTS))
        self.read()

    def read(self) -> None:
        """Reads the joints: angles ``[pages, segments]`` in rad, of the hinge and the bends, and rates in rad/s."""
        states = self._client.getJointStates(self.body, self.joints)
        both = np.array([state[:2] for state in states]).reshape(PAGES, SEGMENTS, 2)
        self.angles, self.rates = both[..., 0], both[..., 1]

    def lay(self, flipped: int) -> None:
        """Lays the upper pages over to the left and the others to the right, at rest."""
        for joint in self.joints:
            page, segment = divmod(joint, SEGMENTS)
            left = page >= PAGES - flipped
            angle = math.pi - MARGIN - (PAGES - 1 - page) * SPREAD if left else MARGIN + page * SPREAD
            self._client.resetJointState(self.body, joint, 0.0 if segment else angle, 0.0)
        self.read()

    @property
    def edges(self) -> np.ndarray:
        """Positions of the pages' free edges, ``[pages, 2]``, x and z in m."""
        direction = np.cumsum(self.angles, 1)
        return LENGTH * np.stack([np.cos(direction).sum(1), np.sin(direction).sum(1)], 1)

    @property
    def edge_angles(self) -> np.ndarray:
        """Angles of the free edges about the ring, ``[pages]``, in (-pi/2, 3 pi/2)."""
        return _polar(*self.edges.T)

    def apply_forces(self) -> None:
        """Applies the bends' springs and the forces between pages for the next physics step."""
        self.read()
        torques = page_torques(self.angles, self.rates)
        torques[:, 1:] -= self.stiffness * (self.angles[:, 1:] - self.curl)
        self._client.setJointMotorControlArray(
            self.body, self.joints, self._client.TORQUE_CONTROL, forces=torques.ravel().tolist()
        )


def _polar(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Angle about the ring; flipped edges may hang below it, so the cut lies straight below."""
    angle = np.arctan2(z, x)
    return np.where(angle < -math.pi / 2, angle + 2 * math.pi, angle)


def page_torques(angles: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Joint torques of the unilateral springs between neighbouring pages, and between the outer ones and the covers.

    Args:
        angles: of the joints, ``[pages, segments]`` in rad.
        rates: of the joints, ``[pages, segments]`` in rad/s.

    Returns:
        Torques, ``[pages, segments]`` in N m.

    Examples:
        >>> apart = np.linspace(0.1, 3.0, PAGES)[:, None] * np.array([1.0, 0.0, 0.0])
        >>> bool((page_torques(apart, np.zeros_like(apart)) == 0).all())
        True
    """
    direction, turn = np.cumsum(angles, 1), np.cumsum(rates, 1)
    dx, dz = LENGTH * np.cos(direction), LENGTH * np.sin(direction)
    x, z = np.cumsum(dx, 1), np.cumsum(dz, 1)
    vx, vz = np.cumsum(-dz * turn, 1), np.cumsum(dx * turn, 1)
    square = x * x + z * z
    radius, phi, phi_rate = np.sqrt(square), _polar(x, z), (x * vz - z * vx) / square
    # Gap j lies below page j; the first and the last are those to the covers.
    gap = np.diff(phi, axis=0, prepend=0.0, append=math.pi)
    opening = np.diff(phi_rate, axis=0, prepend=0.0, append=0.0)
    arm = np.minimum(np.concatenate([radius[:1], radius]), np.concatenate([radius, radius[-1:]]))
    rate = arm * opening
    hard = np.clip(HARD_STIFFNESS * arm * (HARD_GAP - gap) - HARD_DAMPING * rate, 0.0, HARD_MAX) * (gap < HARD_GAP)
    soft = np.clip(SOFT_STIFFNESS * arm * (SOFT_GAP - gap) - SOFT_DAMPING * rate, 0.0, SOFT_MAX) * (gap < SOFT_GAP)
    soft[0] = soft[-1] = 0.0
    push = -np.diff(hard + soft, axis=0)  # tangential force on each segment's end, positive towards the left
    fx, fz = -push * z / radius, push * x / radius
    moment, sum_x, sum_z = (np.cumsum(term[:, ::-1], 1)[:, ::-1] for term in (push * radius, fx, fz))
    return moment - ((x - dx) * sum_z - (z - dz) * sum_x)  # about each segment's own joint
