"""What is expected of an environment (Gymnasium's interface), checked where it answers, and what its actions are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

_SHIM = "as Gymnasium's environments give; wrap an older gym's (shimmy.GymV21CompatibilityV0), make what TorchRL's wrap"


def name_of(env: Any) -> str:
    """How messages call an environment: its id, or the name of its class.

    Examples:
        >>> class Robot: ...
        >>> name_of(Robot())
        'Robot'
    """
    identifier = getattr(getattr(env, "spec", None), "id", None)
    return str(identifier or type(getattr(env, "unwrapped", env)).__name__)


def observation_shape(env: Any) -> tuple[int, ...] | None:
    """Shape of the observations, or None where they are no array or the environment does not say."""
    shape: tuple[int, ...] | None = getattr(getattr(env, "observation_space", None), "shape", None)
    return shape


def begin(env: Any, seed: int, shape: tuple[int, ...] | None) -> Any:
    """Resets an environment.

    Args:
        env: the environment.
        seed: of the episode.
        shape: that the observation must have, see :func:`observation_shape`.

    Returns:
        The first observation.

    Raises:
        ValueError: if it is a vector environment, or what it gives has another form; the message names it.
    """
    if isinstance(getattr(env, "num_envs", None), int):
        raise ValueError(
            f"{name_of(env)} is a vector environment: env_fn must make a single one, the steps are batched"
        )
    if not (callable(getattr(env, "reset", None)) and callable(getattr(env, "step", None))):
        raise ValueError(f"env_fn made a {name_of(env)}, needed is an environment with reset and step")
    try:
        given = env.reset(seed=seed)
    except TypeError as error:
        if "seed" not in str(error):
            raise
        raise ValueError(f"reset of {name_of(env)} takes no seed, needed is reset(seed=...), {_SHIM}") from error
    if not isinstance(given, tuple) or len(given) != 2:
        raise ValueError(f"reset of {name_of(env)} gave {_form(given)}, needed is (observation, info), {_SHIM}")
    return _observed(env, given[0], shape, "reset")


def take(env: Any, action: Any, shape: tuple[int, ...] | None) -> tuple[Any, float, bool, bool]:
    """Takes a step.

    Args:
        env: the environment.
        action: one of its action space.
        shape: that the observation must have, see :func:`observation_shape`.

    Returns:
        Observation, reward, whether the episode terminated, and whether it was truncated.

    Raises:
        ValueError: if what it gives has another form; the message names the environment.
    """
    given = env.step(action)
    if not isinstance(given, tuple) or len(given) != 5:
        needed = "(observation, reward, terminated, truncated, info)"
        raise ValueError(f"step of {name_of(env)} gave {_form(given)}, needed is {needed}, {_SHIM}")
    observation, reward, terminated, truncated, _ = given
    for part, value in (("reward", reward), ("terminated", terminated), ("truncated", truncated)):
        if not isinstance(value, (float, bool)) and np.shape(value) != ():
            raise ValueError(f"step of {name_of(env)} gave a {part} of shape {np.shape(value)}, needed is one number")
    return _observed(env, observation, shape, "step"), float(reward), bool(terminated), bool(truncated)


def _observed(env: Any, observation: Any, shape: tuple[int, ...] | None, method: str) -> Any:
    found: Any = getattr(observation, "shape", shape)
    if found != shape and shape is not None:
        raise ValueError(
            f"{method} of {name_of(env)} gave an observation of shape {tuple(found)}, its observation_space has "
            f"{shape}: correct one of the two"
        )
    return observation


def _form(given: Any) -> str:
    return f"{len(given)} values" if isinstance(given, tuple) else f"a {type(given).__name__}"


class ActionRule:
    """How a policy's output becomes an action of the environment's space.

    =========================== =====================================================================
    space                       rule
    =========================== =====================================================================
    Box                         clipped to its limits; of whole numbers, only such are taken
    Discrete                    a whole number within the limits, or whole numbers that are one-hot, as TorchRL's
    MultiDiscrete               whole numbers within the limits; nothing is clipped or rounded
    MultiBinary                 0 or 1 (or bool)
    Dict, Tuple, any other one  refused by name
    =========================== =====================================================================

    Args:
        env: its ``action_space`` decides; spaces are known by their attributes, so that any library's will do.

    Attributes:
        shape: of an action.

    Raises:
        ValueError: for a space that is refused; the message names space and environment.
    """

    def __init__(self, env: Any) -> None:
        self.env = name_of(env)
        space: Any = getattr(env, "action_space", None)
        self.clipped = hasattr(space, "low") and hasattr(space, "high")
        if self.clipped:
            low, high = space.low, space.high
        elif hasattr(space, "nvec"):
            low = np.zeros_like(space.nvec) + getattr(space, "start", 0)
            high = low + space.nvec - 1
        elif hasattr(space, "n") and getattr(space, "shape", ()) == ():
            low = np.asarray(getattr(space, "start", 0))
            high = low + space.n - 1
        elif hasattr(space, "n"):
            low = np.zeros(space.shape, dtype=np.int8)
            high = low + 1
        else:
            raise ValueError(
                f"the action space of {self.env} is {type(space).__name__}: policies give one array, so that Box, "
                "Discrete, MultiDiscrete and MultiBinary can be run; wrap the environment to one of them, such as by "
                "gymnasium.wrappers.TransformAction"
            )
        self.low, self.high = np.asarray(low), np.asarray(high)
        self.shape = self.low.shape
        self.dtype = self.low.dtype if self.clipped else np.dtype(getattr(space, "dtype", None) or self.low.dtype)
        self.whole = self.dtype.kind != "f"
        self.classes = int(high - low) + 1 if not self.clipped and self.shape == () else 0  # of Discrete

    def legal(self, actions: Sequence[np.ndarray] | np.ndarray) -> Sequence[np.ndarray] | np.ndarray | None:
        """Actions of the space for outputs ``[E, *A]``, or None if :meth:`fault` finds one in any of them."""
        if self.classes:
            actions = [self._index(action) for action in actions]
        # All outputs are tested at once, for speed, as they are clipped, which is np.clip's result.
        if any(action.shape != self.shape for action in actions) or not np.isfinite(actions).all():
            return None
        if self.whole and not np.equal(actions, np.rint(np.asarray(actions, dtype=np.float64))).all():
            return None
        if not self.clipped and not np.logical_and(actions >= self.low, actions <= self.high).all():
            return None
        legal = np.minimum(np.maximum(actions, self.low), self.high).astype(self.dtype, copy=False)
        # A number of a Box is an array without dimensions, one of Discrete a scalar.
        return [np.array(action) for action in legal] if self.clipped and self.shape == () else legal

    def _index(self, action: np.ndarray) -> np.ndarray:
        """What a one-hot output for Discrete says; others stay as they are."""
        if action.shape != (self.classes,) or action.dtype.kind not in "biu" or np.sort(action)[-2:].sum() != 1:
            return action
        return self.low + action.argmax()

    def fault(self, action: np.ndarray) -> str | None:
        """What is wrong with one output ``[*A]``; None if nothing is."""
        if self.legal([action]) is not None:
            return None
        if action.shape != self.shape or not np.isfinite(action).all() or not self.whole:
            what = f"a finite action of shape {self.shape}"
        else:
            what = "an action of whole numbers"
        if not self.clipped:
            low, high = (np.unique(limit) for limit in (self.low, self.high))
            ends = f"{low[0]} to {high[-1]}" if len(low) == len(high) == 1 else f"{self.low} to {self.high}"
            what += f", from {ends}"
        hint = ""
        if self.classes and action.shape == (self.classes,):
            hint = ": if these are scores, return np.argmax of them"
        return f"need {what} for {self.env}, got {action}{hint}"


def is_structured(observation: Any) -> bool:
    """Whether an observation is of several parts (of a Dict or Tuple space) instead of one array.

    Examples:
        >>> is_structured({"image": np.zeros(3)}), is_structured(np.zeros(3))
        (True, False)
    """
    return isinstance(observation, (dict, tuple))
