"""The imitator's deterministic policy without torch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np


def _array(value: Any) -> np.ndarray:
    """Copies a tensor or array to float32."""
    value = value.detach().cpu().float().numpy() if hasattr(value, "detach") else value
    return np.array(value, dtype=np.float32)


class MeanPolicy:
    """The imitator's mean action, computed with NumPy alone so that it travels cheaply to a worker process.

    Row b of a batch is, to the last bit, the action of observation b alone, so that results do not depend on how
    episodes are grouped; :attr:`batched` tells the evaluation so.

    Args:
        layers: one tuple ``(weight [out, in], bias [out], norm_weight [out] or None)`` a linear layer; where a
            norm weight is given, RMSNorm and Squish follow. The last layer gives ``[..., 2 * A]``, mean first.
        eps: RMSNorm's epsilon (float32's machine epsilon, as ``torch.nn.RMSNorm``'s default).

    Raises:
        ValueError: if there is no layer or the output has an odd size.

    Examples:
        >>> policy = MeanPolicy([(np.ones((4, 3)), np.zeros(4), None)])
        >>> policy(np.array([1.0, 2.0, 3.0]))
        array([6., 6.], dtype=float32)
    """

    batched = True

    def __init__(
        self,
        layers: list[tuple[np.ndarray, np.ndarray, np.ndarray | None]],
        eps: float = float(np.finfo(np.float32).eps),
    ) -> None:
        if not layers or layers[-1][0].shape[0] % 2:
            raise ValueError("the last layer must give mean and scale, an even number of outputs; check the layers")
        self.layers = [(_array(w), _array(b), None if norm is None else _array(norm)) for w, b, norm in layers]
        self.eps = eps

    @classmethod
    def from_actor_state(cls, state: Mapping[str, Any], eps: float | None = None) -> MeanPolicy:
        """Reads an actor's ``state_dict``: a 2-d ``weight`` is a linear layer, a 1-d one is its RMSNorm.

        Args:
            state: tensors or arrays by key, in any order; keys end in ``weight`` or ``bias``, and their numbers are the
                layers' order, as in ``torch.nn.Sequential``.
            eps: RMSNorm's epsilon (default as in the class).

        Returns:
            The policy.

        Raises:
            KeyError: if a linear layer has no bias.
            ValueError: if a key or shape is none of the above.

        Examples:
            >>> state = {"0.weight": np.eye(2), "0.bias": np.zeros(2), "1.weight": np.ones(2)}
            >>> state |= {"3.weight": np.eye(2), "3.bias": np.zeros(2)}
            >>> MeanPolicy.from_actor_state(state)(np.zeros(2))
            array([0.], dtype=float32)
        """
        layers: list[tuple[np.ndarray, np.ndarray, np.ndarray | None]] = []
        for key in sorted(state, key=lambda name: [(part.isdigit(), part.zfill(4)) for part in name.split(".")]):
            if key.endswith("bias"):
                continue
            array = _array(state[key])
            if key.endswith("weight") and array.ndim == 2:
                bias = state.get(key[: -len("weight")] + "bias")
                if bias is None:
                    raise KeyError(f"layer {key!r} has no bias: is this the state_dict of make_policy's actor?")
                layers.append((array, _array(bias), None))
            elif key.endswith("weight") and array.ndim == 1 and layers and layers[-1][2] is None:
                layers[-1] = (*layers[-1][:2], array)
            else:
                raise ValueError(f"cannot place {key!r} of shape {array.shape}: expected linear and RMSNorm layers")
        return cls(layers) if eps is None else cls(layers, eps)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Maps an observation ``[*B, obs_dim]`` to the mean action ``[*B, A]``."""
        x = np.asarray(observation, dtype=np.float32)
        for weight, bias, norm in self.layers:
            # Not x @ weight.T: BLAS rounds differently by the size of the batch and the number of threads.
            x = np.einsum("oi,...i->...o", weight, x)
            x += bias
            if norm is not None:
                x /= np.sqrt(np.add.reduce(x * x, -1, keepdims=True) / np.float32(x.shape[-1]) + np.float32(self.eps))
                x *= norm
                x *= (1 + x / np.sqrt(x * x + 4)) / 2
        return x[..., : x.shape[-1] // 2]
