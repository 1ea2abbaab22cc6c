"""The PyBullet Ant as a Gymnasium environment.

The environment equals ``AntBulletEnv-v0`` of ``pybullet_envs_gymnasium`` step
for step. It differs in manners only: it prints nothing, and can be reset again
after it was closed. PyBullet and Gymnasium are imported when an environment is
made, so that the package works without them.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
import sys
import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import gymnasium

ENV_ID = "torchrl_tsallis/Ant-v0"
MAX_EPISODE_STEPS = 1000


def _flush() -> None:
    """Flush Python's and C's output buffers."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()
    with contextlib.suppress(OSError, TypeError, AttributeError):
        ctypes.CDLL(None).fflush(None)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence PyBullet, which writes to the process's streams from C."""
    _flush()
    saved = {}
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        for stream in (1, 2):
            with contextlib.suppress(OSError):
                saved[stream] = os.dup(stream)
                os.dup2(null, stream)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        _flush()
        for stream, copy in saved.items():
            os.dup2(copy, stream)
            os.close(copy)
        os.close(null)


@functools.lru_cache(maxsize=1)
def _ant_class() -> Any:
    """Import PyBullet and derive the environment's class."""
    with _quiet():
        from pybullet_envs_gymnasium.gym_locomotion_envs import AntBulletEnv
        from pybullet_envs_gymnasium.robot_locomotors import Ant

    class AntEnv(AntBulletEnv):
        """``AntBulletEnv`` that keeps quiet and survives being closed."""

        def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
            """Reset the episode; the first reset connects to the physics."""
            if self.physicsClientId >= 0:
                return super().reset(seed=seed, options=options)
            with _quiet():
                return super().reset(seed=seed, options=options)

        def close(self) -> None:
            """Disconnect from the physics; a later reset connects anew."""
            if self.physicsClientId < 0:
                return
            super().close()
            self.stateId = -1
            self.scene = None
            self.robot = Ant()
            self.robot.np_random = self.np_random

    return AntEnv


def create_ant(render_mode: str | None = None) -> gymnasium.Env:
    """Create the bare environment, without a limit on the episode's length."""
    env: gymnasium.Env = _ant_class()(render_mode=render_mode)
    return env


def register_ant() -> None:
    """Register the environment with Gymnasium; a second call does nothing."""
    import gymnasium

    if ENV_ID not in gymnasium.registry:
        gymnasium.register(
            ENV_ID,
            entry_point="torchrl_tsallis.envs.ant:create_ant",
            max_episode_steps=MAX_EPISODE_STEPS,
            reward_threshold=2500.0,
            disable_env_checker=True,
        )


def make_ant(render_mode: str | None = None) -> gymnasium.Env:
    """Make the Ant environment.

    Args:
        render_mode: ``None`` or ``"rgb_array"`` for images, ``"human"`` for a
            window.

    Returns:
        The environment: 28 observations, 8 torques in [-1, 1], truncated after
        1000 steps.
    """
    import gymnasium

    register_ant()
    return gymnasium.make(ENV_ID, render_mode=render_mode)
