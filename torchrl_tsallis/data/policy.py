"""The shipped policies that record demonstrations: small ReLU networks in safetensors files."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open

#: Folder of the shipped policies.
POLICIES = Path(__file__).parent / "policies"
_NAMES = ("w1", "b1", "w2", "b2", "w3", "b3")


class NumpyPolicy:
    """Two hidden ReLU layers and a tanh on the first half of the output, in NumPy.

    Args:
        tensors: ``w1`` ``[obs_dim, H]``, ``b1`` ``[H]``, ``w2`` ``[H, H]``, ``b2`` ``[H]``, ``w3`` ``[H, 2A]``, ``b3``
            ``[2A]``.
        metadata: where the policy is from.

    Raises:
        ValueError: if a tensor is missing or does not fit; the message names it.

    Examples:
        >>> sizes = [(3, 4), (4,), (4, 4), (4,), (4, 2), (2,)]
        >>> policy = NumpyPolicy({name: np.zeros(size) for name, size in zip(_NAMES, sizes)})
        >>> policy(np.ones(3))
        array([0.], dtype=float32)
    """

    def __init__(self, tensors: dict[str, np.ndarray], metadata: dict[str, str] | None = None) -> None:
        missing = [name for name in _NAMES if name not in tensors]
        if missing:
            raise ValueError(f"a policy needs the tensors {', '.join(_NAMES)}; {missing[0]!r} is missing")
        self.tensors = {name: np.asarray(tensors[name], dtype=np.float32) for name in _NAMES}
        self.metadata = metadata or {}
        width = self.tensors["w1"].shape[0]
        for i in (1, 2, 3):
            weight, bias = self.tensors[f"w{i}"], self.tensors[f"b{i}"]
            if weight.ndim != 2 or weight.shape[0] != width or bias.shape != weight.shape[1:]:
                raise ValueError(
                    f"w{i} of shape {list(weight.shape)} and b{i} of shape {list(bias.shape)} do not fit an input of "
                    f"width {width}"
                )
            width = weight.shape[1]

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Deterministic action ``[A]`` of an observation ``[obs_dim]``."""
        t = self.tensors
        x = np.asarray(observation, dtype=np.float32)
        x = np.maximum(np.maximum(x @ t["w1"] + t["b1"], 0) @ t["w2"] + t["b2"], 0) @ t["w3"] + t["b3"]
        return np.tanh(x[..., : x.shape[-1] // 2])

    def act(self, observation: np.ndarray, rng: np.random.Generator, std: float, clip: bool = False) -> np.ndarray:
        """Action with Gaussian noise of standard deviation ``std``, ``[A]``; clipped to [-1, 1] on request."""
        action = self(observation)
        action = action + std * rng.standard_normal(action.shape)
        return (np.clip(action, -1, 1) if clip else action).astype(np.float32)


def load_policy(path: str | os.PathLike[str]) -> NumpyPolicy:
    """Reads a policy.

    Args:
        path: safetensors file, or the name of a shipped policy (``"expert_0"``).

    Returns:
        The policy.

    Raises:
        FileNotFoundError: if there is no such file or shipped policy.
        ValueError: if the file is truncated or its tensors do not fit.

    Examples:
        >>> load_policy("expert_9")
        Traceback (most recent call last):
        ...
        FileNotFoundError: no policy 'expert_9': give a safetensors file or the name of a shipped policy
    """
    file = Path(path)
    if not file.exists():
        file = POLICIES / f"{path}.safetensors"
    if not file.exists():
        raise FileNotFoundError(f"no policy {str(path)!r}: give a safetensors file or the name of a shipped policy")
    try:
        with safe_open(file, "np") as handle:
            tensors = {name: handle.get_tensor(name) for name in handle.keys()}  # noqa: SIM118
            metadata = dict(handle.metadata() or {})
    except SafetensorError as error:
        raise ValueError(f"{str(file)!r} is truncated or no safetensors file ({error}): copy it again") from error
    try:
        return NumpyPolicy(tensors, metadata)
    except ValueError as error:
        raise ValueError(f"{str(file)!r}: {error}") from error
