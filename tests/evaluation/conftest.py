"""A small environment whose returns can be computed by hand, and whose every answer a test can spoil."""

from __future__ import annotations

import types

import numpy as np
import pytest


@pytest.fixture
def make_env():
    """Function of changes, such as ``steps=None``, to what makes environments."""

    class Small:
        """Observation ``[seed, step]``, reward ``sum(action)``, and an end after ``steps`` steps."""

        metadata: dict = {"render_modes": ["rgb_array"]}
        action_space: object = types.SimpleNamespace(low=-np.ones(2, np.float32), high=np.ones(2, np.float32))
        steps: int | None = 3

        def __init__(self, render_mode=None):
            self.render_mode, self.actions = render_mode, []
            self.unwrapped = self

        def look(self):
            return np.array([self.seed, self.t], np.float32)

        def reset(self, seed=None):
            self.seed, self.t = seed, 0
            return self.look(), {}

        def step(self, action):
            self.t += 1
            type(self).actions_seen.append(action)
            return self.look(), float(np.sum(action)), False, self.steps == self.t, {}

        def render(self):
            return np.full((48, 64, 3), 40 * self.t, np.uint8)

        def close(self):
            type(self).closed += 1

    def make(**changes):
        return type("Small", (Small,), {"actions_seen": [], "closed": 0, **changes})

    return make
