"""Registration of the PyBullet Ant with Gymnasium.

PyBullet and Gymnasium are imported when an environment is made, so that the
package works without them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import gymnasium

ENV_ID = "torchrl_tsallis/Ant-v0"
MAX_EPISODE_STEPS = 1000


def register_ant() -> None:
    """Register the environment with Gymnasium; a second call does nothing."""
    import gymnasium

    if ENV_ID not in gymnasium.registry:
        gymnasium.register(
            ENV_ID,
            entry_point="torchrl_tsallis.envs.ant_env:AntEnv",
            max_episode_steps=MAX_EPISODE_STEPS,
            reward_threshold=2500.0,
            disable_env_checker=True,
            order_enforce=False,  # the environment does that itself, more cheaply
        )


def make_ant(render_mode: str | None = None) -> gymnasium.Env:
    """Make the Ant environment.

    Args:
        render_mode: ``None`` or ``"rgb_array"`` for images, ``"human"`` for a
            window.

    Returns:
        The :class:`~torchrl_tsallis.envs.ant_env.AntEnv` with 28 observations, 8
        torques in [-1, 1], truncated after 1000 steps.
    """
    import gymnasium

    register_ant()
    return gymnasium.make(ENV_ID, render_mode=render_mode)
