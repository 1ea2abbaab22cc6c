"""The shipped policies that record demonstrations: small ReLU networks in safetensors files."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open

from torchrl_tsallis._checks import check_path, shown

#: Folder of the shipped policies.
POLICIES = Path(__file__).parent / "policies"
_NAMES = ("w1", "b1", "w2", "b2", "w3", "b3")


def as_observation(observation: Any, width: int) -> np.ndarray:
    """Checks what a policy in NumPy is asked.

    Args:
        observation: ``[*B, width]``.
        width: of the policy's first layer.

    Returns:
        The observation in float32.

    Raises:
        ValueError: if it is no array of numbers, or its last dimension is another one.

    Examples:
        >>> as_observation(np.zeros(4), 3)
        Traceback (most recent call last):
        ...
        ValueError: the policy takes observations [..., 3], got shape (4,): was it trained in this environment?
    """
    try:
        x = np.asarray(observation, dtype=np.float32)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"the policy takes one array [..., {width}], got a {type(observation).__name__}: flatten the observation, "
            "such as by gymnasium.wrappers.FlattenObservation"
        ) from error
    if x.shape[-1:] != (width,):
        raise ValueError(
            f"the policy takes observations [..., {width}], got shape {x.shape}: was it trained in this environment?"
        )
    return x


def as_weights(name: str, value: Any) -> np.ndarray:
    """Copies a tensor or array of weights to float32.

    Args:
        name: for the message.
        value: any shape.

    Returns:
        The copy.

    Raises:
        ValueError: if it is no array of numbers, or one of them is not finite.

    Examples:
        >>> as_weights("w1", [1.0, float("nan")])
        Traceback (most recent call last):
        ...
        ValueError: w1 is not finite: the training has diverged, or the file is damaged
    """
    value = value.detach().cpu().float().numpy() if hasattr(value, "detach") else value
    try:
        array = np.array(value, dtype=np.float32)
    except Exception as error:  # whatever an object that is no array raises
        raise ValueError(f"{name} must be an array of numbers, got a {type(value).__name__}") from error
    if not np.isfinite(array).all():
        raise ValueError(f"{name} is not finite: the training has diverged, or the file is damaged")
    return array


class NumpyPolicy:
    """Two hidden ReLU layers and a tanh on the first half of the output, in NumPy.

    Args:
        tensors: ``w1`` ``[obs_dim, H]``, ``b1`` ``[H]``, ``w2`` ``[H, H]``, ``b2`` ``[H]``, ``w3`` ``[H, 2A]``, ``b3``
            ``[2A]``.
        metadata: where the policy is from.

    Raises:
        ValueError: if a tensor is missing, does not fit or is not finite, or there are others; the message names it.

    Examples:
        >>> sizes = [(3, 4), (4,), (4, 4), (4,), (4, 2), (2,)]
        >>> policy = NumpyPolicy({name: np.zeros(size) for name, size in zip(_NAMES, sizes)})
        >>> policy(np.ones(3))
        array([0.], dtype=float32)
    """

    def __init__(self, tensors: dict[str, np.ndarray], metadata: dict[str, str] | None = None) -> None:
        if not isinstance(tensors, Mapping):
            raise TypeError(f"tensors must be a mapping, name -> array, of {', '.join(_NAMES)}; got {shown(tensors)}")
        if not isinstance(metadata, (Mapping, NoneType)):
            raise TypeError(f"metadata must be a mapping, or None, got {shown(metadata)}")
        missing = [name for name in _NAMES if name not in tensors]
        if missing:
            raise ValueError(
                f"a policy needs the tensors {', '.join(_NAMES)}; {missing[0]!r} is missing, there are "
                f"{', '.join(sorted(map(str, tensors))) or 'none'}"
            )
        if others := sorted(set(tensors) - set(_NAMES)):
            raise ValueError(
                f"a policy has the tensors {', '.join(_NAMES)}, two ReLU layers and a tanh; {others[0]!r} is one more, "
                "of another network"
            )
        self.tensors = {name: as_weights(name, tensors[name]) for name in _NAMES}
        self.metadata = {} if metadata is None else dict(metadata)
        if self.tensors["w1"].ndim != 2:
            raise ValueError(f"w1 of shape {list(self.tensors['w1'].shape)} must be a matrix [obs_dim, H]")
        width = self.tensors["w1"].shape[0]
        for i in (1, 2, 3):
            weight, bias = self.tensors[f"w{i}"], self.tensors[f"b{i}"]
            if weight.ndim != 2 or weight.shape[0] != width or bias.shape != weight.shape[1:]:
                raise ValueError(
                    f"w{i} of shape {list(weight.shape)} and b{i} of shape {list(bias.shape)} do not fit an input of "
                    f"width {width}"
                )
            width = weight.shape[1]
        if width % 2:
            raise ValueError(f"w3 must give mean and scale, an even number of outputs, not {width}")

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Deterministic action ``[A]`` of an observation ``[obs_dim]``."""
        t = self.tensors
        x = as_observation(observation, len(t["w1"]))
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
    path = check_path("path", path)
    file = Path(path)
    if not os.path.isfile(file):  # Path.exists() raises for a name that is too long
        file = POLICIES / f"{path}.safetensors"
    if not os.path.isfile(file):
        raise FileNotFoundError(f"no policy {shown(path)}: give a safetensors file or the name of a shipped policy")
    try:
        with safe_open(file, "np") as handle:
            tensors = {name: handle.get_tensor(name) for name in handle.keys()}  # noqa: SIM118
            metadata = dict(handle.metadata() or {})
        if lacking := sorted({str(value.dtype) for value in tensors.values() if value.dtype.kind not in "fiub"}):
            raise TypeError(lacking[0])  # some packages add bfloat16 to NumPy, in three digits
    except SafetensorError as error:
        raise ValueError(f"{str(file)!r} is truncated or no safetensors file ({error}): copy it again") from error
    except TypeError as error:  # bfloat16 and float8, which NumPy lacks
        raise ValueError(f"{str(file)!r} has a data type without a twin in NumPy ({error}): save float32") from error
    try:
        return NumpyPolicy(tensors, metadata)
    except ValueError as error:
        raise ValueError(f"{str(file)!r}: {error}") from error
