"""The recurrent imitator's deterministic policy without torch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from torchrl_tsallis._checks import check_number, shown
from torchrl_tsallis.data.policy import as_observation, as_weights

_LSTM = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
_PARTS = ("w_ih", "w_hh", "bias")
_SCALING = ("observation_mean", "observation_std", "action_unit")


class RecurrentMeanPolicy:
    """The recurrent imitator's mean action, computed with NumPy alone so that it travels cheaply to a worker process.

    It remembers: :meth:`reset` before each trial, then one call a step. Inputs and outputs are in the units of the
    robot; the scaling is part of the policy.

    Args:
        layers: of each LSTM layer, ``(w_ih [4H, I], w_hh [4H, H], bias [4H])`` in torch's order of gates.
        head: ``(weight [2A, H], bias [2A])`` of the normal's parameters, the mean first.
        mean: of the observation, ``[O]``.
        std: of the observation, ``[O]``.
        action_unit: unit of the network's action.

    Raises:
        ValueError: if shapes do not fit, a number is not finite, or a standard deviation or the unit is not positive.

    Examples:
        >>> layer = (np.zeros((8, 3)), np.zeros((8, 2)), np.zeros(8))
        >>> policy = RecurrentMeanPolicy([layer], (np.zeros((2, 2)), np.ones(2)), np.zeros(3), np.ones(3), 0.5)
        >>> policy(np.zeros(3))
        array([0.5], dtype=float32)
    """

    def __init__(
        self,
        layers: list[tuple[np.ndarray, np.ndarray, np.ndarray]],
        head: tuple[np.ndarray, np.ndarray],
        mean: np.ndarray,
        std: np.ndarray,
        action_unit: float,
    ) -> None:
        self.mean, self.std = as_weights("observation_mean", mean), as_weights("observation_std", std)
        if not isinstance(layers, (list, tuple)) or not layers:
            raise TypeError(f"layers must be a list of tuples (w_ih, w_hh, bias), at least one, got {shown(layers)}")
        for name, part, size in (("head", head, 2), *((f"layers[{i}]", layer, 3) for i, layer in enumerate(layers))):
            if not isinstance(part, (list, tuple)) or len(part) != size:
                raise TypeError(f"{name} must be a tuple of {size} arrays, got {shown(part)}")
        self.action_unit = np.float32(check_number("action_unit", action_unit))
        self.layers, width = [], len(np.atleast_1d(self.mean))
        _check_shape("observation_mean", self.mean, (width,))
        _check_shape("observation_std", self.std, (width,))
        if not (self.std > 0).all() or not 0 < self.action_unit < np.inf:
            raise ValueError(f"observation_std and action_unit must be positive, got {self.std} and {self.action_unit}")
        for i, (w, u, b) in enumerate(layers):
            w, u, b = (as_weights(f"{name} of LSTM layer {i}", x) for name, x in zip(_PARTS, (w, u, b), strict=True))
            hidden = u.shape[-1] if u.ndim else 0
            shapes = ((4 * hidden, width), (4 * hidden, hidden), (4 * hidden,))
            for name, x, shape in zip(_PARTS, (w, u, b), shapes, strict=True):
                _check_shape(f"{name} of LSTM layer {i}", x, shape)
            self.layers.append((np.concatenate([w, u], 1), b))
            width = hidden
        self.head = as_weights("the head's weight", head[0]), as_weights("the head's bias", head[1])
        actions = len(np.atleast_1d(self.head[1])) // 2
        _check_shape("the head's weight", self.head[0], (2 * actions, width))
        _check_shape("the head's bias", self.head[1], (2 * actions,))
        self.reset()

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> RecurrentMeanPolicy:
        """Reads the ``state_dict`` of :func:`~torchrl_tsallis.modules.make_recurrent_policy`'s actor and of a scaling.

        Args:
            state: tensors or arrays: those of the actor, and :meth:`~torchrl_tsallis.data.Scaling.state_dict`'s.

        Returns:
            The policy, at the start of a trial.

        Raises:
            KeyError: if an entry is missing; the message names it.
            ValueError: if there are others, of another network: a GRU, a deeper head, projections, both directions.
        """
        stems = {str(name)[: -len("weight_ih_l0")] for name in state if str(name).endswith("weight_ih_l0")}
        heads = [str(name)[: -len("0.weight")] for name in state if str(name).endswith(".0.weight")]
        if not stems or not heads:
            raise KeyError("there is no LSTM layer or no head: is this the state of make_recurrent_policy's actor?")
        # Of the actor: LSTM, Sequential(Linear, NormalHead), and perhaps one linear layer that predicts.
        stem, head = sorted(stems)[0], sorted(heads)[0]
        depth = sum(str(name).startswith(f"{stem}weight_ih_l") and str(name)[-1].isdigit() for name in state)
        names = [f"{stem}{name}_l{number}" for number in range(depth) for name in _LSTM]
        names += [f"{head}0.weight", f"{head}0.bias", *_SCALING]
        if missing := [name for name in names if name not in state]:
            raise KeyError(
                f"{missing[0]!r} is missing: needed are the state of make_recurrent_policy's actor, and of a Scaling "
                f"({', '.join(_SCALING)})"
            )
        others = {str(name) for name in state} - set(names)
        predictor = {name for name in others if name.endswith(("module.weight", "module.bias"))}
        if len(predictor) == 2 and len({name.rpartition(".")[0] for name in predictor}) == 1:
            others -= predictor
        if others:
            raise ValueError(
                f"cannot place {sorted(others)[0]!r}: expected are LSTM layers, one linear head of the action and one "
                "of the prediction; pass another network's actor itself, not its state: it is then run by torch"
            )
        arrays = {name: as_weights(repr(name), state[name]) for name in names}
        if arrays["action_unit"].size != 1:
            raise ValueError(f"action_unit must be one number, got shape {arrays['action_unit'].shape}")
        layers = []
        for number in range(depth):
            w, u, b, c = (arrays[f"{stem}{name}_l{number}"] for name in _LSTM)
            if w.ndim == 2 and u.ndim == 2 and len(w) == 3 * u.shape[1]:
                raise ValueError(f"layer {number} has the 3 gates of a GRU, expected are the 4 of an LSTM")
            _check_shape(f"{stem}bias_hh_l{number}", c, b.shape)
            layers.append((w, u, b + c))
        parts = arrays[f"{head}0.weight"], arrays[f"{head}0.bias"]
        mean, std, unit = (arrays[name] for name in _SCALING)
        return cls(layers, parts, mean, std, float(unit.item()))

    def reset(self) -> None:
        """Forgets: the next call is the first of a trial."""
        self._state = [np.zeros((2, w.shape[0] // 4), dtype=np.float32) for w, _ in self.layers]

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Maps an observation ``[O]`` to the mean action ``[A]``, and remembers."""
        x = as_observation(observation, len(self.mean))
        if x.ndim != 1:
            raise ValueError(
                f"a policy with memory takes one observation [{len(self.mean)}] a call, got shape {x.shape}"
            )
        x = (x - self.mean) / self.std
        for (weight, bias), state in zip(self.layers, self._state, strict=True):
            i, f, g, o = (weight @ np.concatenate([x, state[0]]) + bias).reshape(4, -1)
            state[1] = _sigmoid(f) * state[1] + _sigmoid(i) * np.tanh(g)
            state[0] = x = _sigmoid(o) * np.tanh(state[1])
        out = self.head[0] @ x + self.head[1]
        return self.action_unit * out[: len(out) // 2]


def _check_shape(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {list(shape)}, got {list(array.shape)}")


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return np.float32(0.5) * (1 + np.tanh(np.float32(0.5) * x))  # never overflows
