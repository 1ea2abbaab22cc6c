"""The imitator's deterministic policy without torch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from torchrl_tsallis._checks import check_number, shown
from torchrl_tsallis.data.policy import as_observation, as_weights

_LAYOUT = (
    "numbered as make_policy's Sequential: Linear 0, RMSNorm 1, Squish 2 (without parameters), Linear 3, ..., the last "
    "Linear with mean and scale"
)
_OTHER = "pass another network's actor itself, not its state: it is then run by torch"


class MeanPolicy:
    """The imitator's mean action, computed with NumPy alone so that it travels cheaply to a worker process.

    Row b of a batch is, to the last bit, the action of observation b alone, so that results do not depend on how
    episodes are grouped; :attr:`batched` tells the evaluation so.

    Args:
        layers: one tuple ``(weight [out, in], bias [out], norm_weight [out] or None)`` a linear layer; where a
            norm weight is given, RMSNorm and Squish follow. The last layer gives ``[..., 2 * A]``, mean first.
        eps: RMSNorm's epsilon (float32's machine epsilon, as ``torch.nn.RMSNorm``'s default).

    Raises:
        ValueError: if there is no layer, shapes do not fit, a number is not finite, or the output has an odd size.

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
        self.layers: list[tuple[np.ndarray, np.ndarray, np.ndarray | None]] = []
        if not isinstance(layers, (list, tuple)) or not all(isinstance(x, tuple) and len(x) == 3 for x in layers):
            raise TypeError(f"layers must be a list of tuples (weight, bias, norm or None), got {shown(layers)}")
        width = None
        for i, (w, b, norm) in enumerate(layers):
            weight, bias = as_weights(f"the weight of layer {i}", w), as_weights(f"the bias of layer {i}", b)
            scale = None if norm is None else as_weights(f"the norm of layer {i}", norm)
            shapes = [part.shape for part in (weight, bias, scale) if part is not None]
            fits = weight.ndim == 2 and width in (None, weight.shape[1])
            if not fits or any(shape != weight.shape[:1] for shape in shapes[1:]):
                needed = "[out, in], [out] and [out]" if width is None else f"[out, {width}], [out] and [out]"
                raise ValueError(f"layer {i}: weight, bias and norm must be {needed}, got {shapes}")
            self.layers.append((weight, bias, scale))
            width = len(weight)
        if not layers or not width or width % 2:
            raise ValueError("the last layer must give mean and scale, an even number of outputs; check the layers")
        self.eps = check_number("eps", eps, low=0)

    @classmethod
    def from_actor_state(cls, state: Mapping[str, Any], eps: float | None = None) -> MeanPolicy:
        """Reads the ``state_dict`` of an actor of :func:`~torchrl_tsallis.modules.make_policy`.

        A 2-d ``weight`` is a linear layer, a 1-d one its RMSNorm. The keys' numbers must leave the places that
        ``make_policy`` leaves, one to each Squish. An activation in such a place that is another one, or a squashed
        distribution, leaves no trace in a state: of such an actor, pass the actor itself to the evaluation.

        Args:
            state: tensors or arrays by key, in any order; keys end in ``weight`` or ``bias``, and their numbers are the
                layers' order, as in ``torch.nn.Sequential``.
            eps: RMSNorm's epsilon (default as in the class).

        Returns:
            The policy.

        Raises:
            KeyError: if a linear layer has no bias.
            ValueError: if a key, a number or a shape is none of the above; the message names what was found.

        Examples:
            >>> state = {"0.weight": np.eye(2), "0.bias": np.zeros(2), "1.weight": np.ones(2)}
            >>> state |= {"3.weight": np.eye(2), "3.bias": np.zeros(2)}
            >>> MeanPolicy.from_actor_state(state)(np.zeros(2))
            array([0.], dtype=float32)
        """
        layers: list[tuple[np.ndarray, np.ndarray, np.ndarray | None]] = []
        places: list[tuple[str, int]] = []  # of linear layers and norms: what stands before the number, and the number
        used = set()
        for key in sorted(state, key=lambda name: [(part.isdigit(), part.zfill(4)) for part in str(name).split(".")]):
            stem, _, leaf = str(key).rpartition(".")
            before, _, number = stem.rpartition(".")
            if leaf == "bias":
                continue
            array = as_weights(f"{key!r}", state[key])
            linear = array.ndim == 2
            if leaf != "weight" or not number.isdigit() or not (linear or (array.ndim == 1 and layers)):
                raise ValueError(
                    f"cannot place {key!r} of shape {array.shape}: expected are layers {_LAYOUT}; {_OTHER}"
                )
            if linear:
                bias = state.get(f"{stem}.bias")
                if bias is None:
                    raise KeyError(f"layer {key!r} has no bias: is this the state_dict of make_policy's actor?")
                used.add(f"{stem}.bias")
                layers.append((array, as_weights(f"{stem}.bias", bias), None))
            else:
                layers[-1] = (*layers[-1][:2], array)
            places.append((before, int(number)))
        numbers = [number for i in range(len(layers)) for number in (3 * i, 3 * i + 1)][:-1]
        if places and places != [(places[0][0], number) for number in numbers]:
            found = ", ".join(f"{before}.{number}".lstrip(".") for before, number in places)
            raise ValueError(f"found parameters at {found}; expected are layers {_LAYOUT}; {_OTHER}")
        others = sorted(str(key) for key in state if str(key).endswith("bias") and key not in used)
        if others:
            raise ValueError(f"{others[0]!r} belongs to no linear layer (RMSNorm has no bias); {_OTHER}")
        return cls(layers) if eps is None else cls(layers, eps)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Maps an observation ``[*B, obs_dim]`` to the mean action ``[*B, A]``."""
        x = as_observation(observation, self.layers[0][0].shape[1])
        for weight, bias, norm in self.layers:
            # Not x @ weight.T: BLAS rounds differently by the size of the batch and the number of threads.
            x = np.einsum("oi,...i->...o", weight, x)
            x += bias
            if norm is not None:
                x /= np.sqrt(np.add.reduce(x * x, -1, keepdims=True) / np.float32(x.shape[-1]) + np.float32(self.eps))
                x *= norm
                x *= (1 + x / np.sqrt(x * x + 4)) / 2
        return x[..., : x.shape[-1] // 2]
