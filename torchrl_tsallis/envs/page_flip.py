"""Page flipping with a haptic arm, simulated in PyBullet, as a Gymnasium environment.

Section VI of the paper flips pages of a ring-bound notebook by a real 3D Systems Touch. This environment is a
simulation of that task: pages move only through contact with the ball at the arm's tip. Physics and the low-level
force loop run at 500 Hz, commands at 50 Hz, and an episode lasts 10 s.

World frame, right-handed, in m: the notebook's ring is the y axis, closed pages lie along +x, flipped ones along -x,
z points up. Forces are in N, angles in rad.

PyBullet and Gymnasium are imported when an environment is made.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_tsallis.envs._arm import FORCE_LIMIT, LINK, SHOULDER
from torchrl_tsallis.envs.flips import FlipCount, count_flips

if TYPE_CHECKING:
    import gymnasium

PAGE_FLIP_ID = "torchrl_tsallis/PageFlip-v0"
PAGE_FLIP_STEPS = 500


@functools.lru_cache(maxsize=1)
def _page_flip_class() -> Any:
    """Import Gymnasium and derive the environment's class."""
    import gymnasium
    from gymnasium import spaces

    from torchrl_tsallis.envs._flip_world import FlipWorld, limit_force

    class PageFlipEnv(gymnasium.Env):
        """A haptic arm at a notebook of ten pages.

        Observation ``[12]`` float32: position of the tip (3, m) and exerted force (3, N) now, and the same one step
        before. Action ``[3]`` float32: force the arm exerts for the next 20 ms (N); a longer vector than 3.3 N is
        shortened. Reward: change of the number of flipped pages, so that its sum is
        :func:`~torchrl_tsallis.envs.flips.count_flips`'s total. The policy sees no page; ``info`` does:

        ============== ========= =============================================================
        key            shape     meaning
        ============== ========= =============================================================
        hinge_angles   [10]      angle of each page at the ring, rad; page 0 lies at the bottom
        edge_angles    [10]      angle of each page's free edge about the ring, rad
        edges          [10, 2]   position of each page's free edge, x and z, m
        contact_force  [3]       mean force of the notebook on the tip over the last 20 ms, N
        flips          scalar    flipped pages so far
        events         scalar    flip events so far; pages within 0.6 s are one
        multiples      scalar    events of two pages or more so far
        ============== ========= =============================================================
        """

        metadata = {"render_modes": ["rgb_array"], "render_fps": 50}

        def __init__(self, render_mode: str | None = None) -> None:
            if render_mode not in (None, "rgb_array"):
                raise ValueError(f"render_mode={render_mode!r} is not supported: use None or 'rgb_array'")
            self.render_mode = render_mode
            self._render_width, self._render_height = 480, 320
            reach = np.full(3, 2 * LINK + 0.01)
            force = np.full(3, FORCE_LIMIT)
            low = np.concatenate([SHOULDER - reach, -force] * 2).astype(np.float32)
            high = np.concatenate([SHOULDER + reach, force] * 2).astype(np.float32)
            self.observation_space = spaces.Box(low, high, dtype=np.float32)
            limit = np.full(3, FORCE_LIMIT, dtype=np.float32)
            self.action_space = spaces.Box(-limit, limit, dtype=np.float32)
            self._world: FlipWorld | None = None
            self._history: list[np.ndarray] = []
            self._force = np.zeros(3, dtype=np.float32)
            self._previous = np.zeros(6, dtype=np.float32)
            self._contact = np.zeros(3)
            self._flips = 0

        @property
        def world(self) -> FlipWorld:
            """The physics; made when it is first needed."""
            if self._world is None:
                self._world = FlipWorld()
            return self._world

        def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
            """Start a trial: all pages on the right, the tip at rest near their free edges."""
            super().reset(seed=seed)
            self.world.reset(self.np_random)
            self._force, self._contact, self._flips = np.zeros(3, dtype=np.float32), np.zeros(3), 0
            self._history = [self.world.notebook.edge_angles]
            self._previous = self._now()
            return np.concatenate([self._previous, self._previous]), self._info(count_flips(self.angle_history))

        def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            """Exert a force for 20 ms."""
            if not self._history:
                raise RuntimeError("call reset before step")
            if not np.isfinite(action).all():
                raise ValueError(f"the force {np.asarray(action).tolist()} is not finite")
            self._previous = self._now()
            self._force = limit_force(action)
            self._contact = self.world.step(self._force.astype(np.float64))
            self._history.append(self.world.notebook.edge_angles)
            flips = count_flips(self.angle_history)
            reward, self._flips = float(flips.total - self._flips), flips.total
            return np.concatenate([self._now(), self._previous]), reward, False, False, self._info(flips)

        @property
        def angle_history(self) -> np.ndarray:
            """Angles of the free edges since the reset, ``[T + 1, 10]`` in rad."""
            return np.stack(self._history)

        def _now(self) -> np.ndarray:
            return np.concatenate([self.world.arm.position, self._force]).astype(np.float32)

        def _info(self, flips: FlipCount) -> dict[str, Any]:
            notebook = self.world.notebook
            return {
                "hinge_angles": notebook.angles[:, 0].copy(),
                "edge_angles": self._history[-1].copy(),
                "edges": notebook.edges,
                "contact_force": self._contact.copy(),
                "flips": flips.total,
                "events": len(flips.sizes),
                "multiples": flips.multiples,
            }

        def render(self) -> np.ndarray | None:
            """Draw the scene, ``[height, width, 3]`` uint8, in the mode ``rgb_array``."""
            if self.render_mode is None:
                return None
            return self.world.render(self._render_width, self._render_height)

        def close(self) -> None:
            """Disconnect from the physics; a later reset connects anew."""
            if self._world is not None:
                self._world.close()
            self._world, self._history = None, []

    return PageFlipEnv


def create_page_flip(render_mode: str | None = None) -> gymnasium.Env:
    """Create the bare environment, without a limit on the episode's length."""
    env: gymnasium.Env = _page_flip_class()(render_mode=render_mode)
    return env


def register_page_flip() -> None:
    """Register the environment with Gymnasium; a second call does nothing."""
    import gymnasium

    if PAGE_FLIP_ID not in gymnasium.registry:
        gymnasium.register(
            PAGE_FLIP_ID,
            entry_point="torchrl_tsallis.envs.page_flip:create_page_flip",
            max_episode_steps=PAGE_FLIP_STEPS,
            disable_env_checker=True,
        )


def make_page_flip(render_mode: str | None = None) -> gymnasium.Env:
    """Make the page flipping environment.

    Args:
        render_mode: ``None``, or ``"rgb_array"`` for images.

    Returns:
        The environment with 12 observations, 3 forces in [-3.3, 3.3] N, truncated after 500 steps of 20 ms.
    """
    import gymnasium

    register_page_flip()
    return gymnasium.make(PAGE_FLIP_ID, render_mode=render_mode)
