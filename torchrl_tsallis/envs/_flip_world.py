"""The physics of page flipping: a haptic arm at a notebook, in one PyBullet client."""

from __future__ import annotations

import functools
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_tsallis.envs._arm import FORCE_LIMIT, GRAVITY, Arm, arm_urdf
from torchrl_tsallis.envs._notebook import Notebook, notebook_urdf
from torchrl_tsallis.envs._quiet import quiet

RATE = 500  # Hz, physics and low-level loop
SUBSTEPS = 10  # physics steps a command: 50 Hz
START = (0.125, 0.0, 0.04)  # m, of the tip
START_NOISE = 0.005  # m, standard deviation
SETTLE, SETTLE_RESET = 300, 150  # physics steps
CAMERA = {"cameraEyePosition": (0.05, -0.46, 0.24), "cameraTargetPosition": (0.045, 0.0, 0.085)}  # m


class _Client:
    """PyBullet's functions, bound to a connection of their own."""

    def __init__(self) -> None:
        import pybullet

        self._api = pybullet
        self._id = pybullet.connect(pybullet.DIRECT)

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._api, name)
        if callable(value):
            value = functools.partial(value, physicsClientId=self._id)
        setattr(self, name, value)
        return value


class FlipWorld:
    """Arm and notebook, stepped at 50 Hz.

    All randomness of a trial is in :meth:`reset`: the tip's start, the paper's stiffness and its curl. Equal seeds and
    forces give bitwise equal trials, also in another process.
    """

    def __init__(self) -> None:
        with quiet():
            self.client: Any = _Client()
            self.client.setGravity(0.0, 0.0, -GRAVITY)
            self.client.setPhysicsEngineParameter(
                fixedTimeStep=1 / RATE,
                numSolverIterations=50,
                numSubSteps=0,
                erp=0.2,
                contactERP=0.2,
                deterministicOverlappingPairs=1,
            )
            with tempfile.TemporaryDirectory() as folder:
                for name, text in (("notebook", notebook_urdf()), ("arm", arm_urdf())):
                    (Path(folder) / f"{name}.urdf").write_text(text)
                self.notebook = Notebook(self.client, f"{folder}/notebook.urdf")
                self.arm = Arm(self.client, f"{folder}/arm.urdf")
        self.arm.place(np.array(START))
        self.notebook.lay(0)
        self._advance(np.zeros(3), SETTLE)
        self._state = self.client.saveState()

    def reset(self, rng: np.random.Generator) -> None:
        """Starts a trial: all pages lie on the right, the tip hovers at their free edges."""
        self.client.restoreState(self._state)
        self.arm.place(np.array(START) + START_NOISE * np.clip(rng.standard_normal(3), -2, 2))
        self.notebook.curl = 0.1 + rng.uniform(-0.02, 0.02)
        self.notebook.stiffness = 0.01 * rng.uniform(0.8, 1.2)
        self.notebook.read()
        self._advance(np.zeros(3), SETTLE_RESET)

    def step(self, force: np.ndarray) -> np.ndarray:
        """Exerts a force ``[3]`` in N for 20 ms, and returns the mean force ``[3]`` of the notebook on the tip."""
        return self._advance(force, SUBSTEPS)

    def _advance(self, force: np.ndarray, steps: int) -> np.ndarray:
        contact = np.zeros(3)
        for _ in range(steps):
            self.notebook.apply_forces()
            self.arm.apply_force(force)
            self.client.stepSimulation()
            for point in self.client.getContactPoints(self.arm.body, self.notebook.body):
                normal, first, second = np.array(point[7]), np.array(point[11]), np.array(point[13])
                contact += point[9] * normal + point[10] * first + point[12] * second
        self.notebook.read()
        self.arm.read()
        return contact / steps

    def render(self, width: int, height: int) -> np.ndarray:
        """Draws the scene by the software renderer, ``[height, width, 3]`` uint8."""
        client = self.client
        view = client.computeViewMatrix(**CAMERA, cameraUpVector=(0.0, 0.0, 1.0))
        projection = client.computeProjectionMatrixFOV(39.0, width / height, 0.05, 2.0)
        image = client.getCameraImage(
            width, height, view, projection, lightDirection=(0.3, -0.8, 1.0), renderer=client.ER_TINY_RENDERER
        )[2]
        return np.asarray(image, dtype=np.uint8).reshape(height, width, 4)[..., :3]

    def close(self) -> None:
        """Disconnects from the physics."""
        self.client.disconnect()


def limit_force(force: np.ndarray) -> np.ndarray:
    """Shortens a force ``[3]`` in N to the arm's limit and rounds it to float32.

    Examples:
        >>> limit_force(np.array([0.0, 0.0, 5.0]))
        array([0. , 0. , 3.3], dtype=float32)
    """
    force = np.asarray(force, dtype=np.float64)
    norm = float(np.linalg.norm(force))
    return (force * min(1.0, FORCE_LIMIT / max(norm, 1e-9))).astype(np.float32)
