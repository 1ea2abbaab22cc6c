"""The recurrent imitator's deterministic policy without torch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from torchrl_tsallis.evaluation.mean_policy import _array


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
        self.layers = [(np.concatenate([_array(w), _array(u)], 1), _array(b)) for w, u, b in layers]
        self.head = _array(head[0]), _array(head[1])
        self.mean, self.std = _array(mean), _array(std)
        self.action_unit = np.float32(action_unit)
        self.reset()

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> RecurrentMeanPolicy:
        """Reads the ``state_dict`` of :func:`~torchrl_tsallis.modules.make_recurrent_policy`'s actor and of a scaling.

        Args:
            state: tensors or arrays: those of the actor, and :meth:`~torchrl_tsallis.data.Scaling.state_dict`'s.

        Returns:
            The policy, at the start of a trial.

        Raises:
            KeyError: if an entry is missing.
        """
        layers: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        while names := [name for name in state if name.endswith(f"weight_ih_l{len(layers)}")]:
            stem, number = names[0][: -len(f"weight_ih_l{len(layers)}")], len(layers)
            w, u, b, c = (
                _array(state[f"{stem}{name}_l{number}"]) for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
            )
            layers.append((w, u, b + c))
        heads = sorted(name for name in state if name.endswith(".0.weight"))  # of Sequential(Linear, NormalHead)
        if not layers or not heads:
            raise KeyError("there is no LSTM layer or no head: is this the state of make_recurrent_policy's actor?")
        head = _array(state[heads[0]]), _array(state[heads[0][: -len("weight")] + "bias"])
        mean, std = _array(state["observation_mean"]), _array(state["observation_std"])
        return cls(layers, head, mean, std, float(_array(state["action_unit"]).item()))

    def reset(self) -> None:
        """Forgets: the next call is the first of a trial."""
        self._state = [np.zeros((2, w.shape[0] // 4), dtype=np.float32) for w, _ in self.layers]

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Maps an observation ``[O]`` to the mean action ``[A]``, and remembers."""
        x = (np.asarray(observation, dtype=np.float32) - self.mean) / self.std
        for (weight, bias), state in zip(self.layers, self._state, strict=True):
            i, f, g, o = (weight @ np.concatenate([x, state[0]]) + bias).reshape(4, -1)
            state[1] = _sigmoid(f) * state[1] + _sigmoid(i) * np.tanh(g)
            state[0] = x = _sigmoid(o) * np.tanh(state[1])
        out = self.head[0] @ x + self.head[1]
        return self.action_unit * out[: len(out) // 2]


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return np.float32(0.5) * (1 + np.tanh(np.float32(0.5) * x))  # never overflows
