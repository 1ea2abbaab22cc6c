"""Recording of demonstrations, their storage, and the checks that bad data fails early."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from tensordict import TensorDict, TensorDictBase

from torchrl_tsallis.data.policy import NumpyPolicy
from torchrl_tsallis.jobs import atomic_path

#: Side entries that training never reads.
LABELS = ("episode", "expert", "ep_return", "reward", "is_noise", "is_amateur")


def record_trajectory(
    make_env: Callable[[], Any],
    policy: NumpyPolicy,
    *,
    std: float,
    seed: int,
    length: int = 999,
    clip: bool = False,
    tries: int = 20,
) -> tuple[TensorDict, int]:
    """Rolls a policy out with noisy actions until an episode lasts long enough.

    Args:
        make_env: makes the gymnasium environment; a fresh one is used, so that nothing carries over.
        policy: the demonstrator.
        std: standard deviation of the Gaussian noise on its actions, in units of the action.
        seed: of the environment and the noise.
        length: number of pairs to record.
        clip: whether actions are clipped to [-1, 1]. Default: False, the command is recorded as it was sampled and the
            robot saturates it: clipped commands lie on the limits in a share of the samples, where a normal
            distribution's density has no bound.
        tries: episodes that may end early before this is an error.

    Returns:
        The pairs, ``[length]``, and the number of discarded episodes. The recorded action is the command
        that the environment was given.

    Raises:
        RuntimeError: if every episode ended early.
    """
    env = make_env()
    env.reset(seed=seed)  # the first episode of a fresh PyBullet environment starts unlike all later ones
    for attempt in range(tries):
        rng = np.random.default_rng([seed, attempt])
        observation, _ = env.reset(seed=seed + 1_000_003 * attempt)
        rows: list[tuple[np.ndarray, np.ndarray, float]] = []
        done = False
        while not done and len(rows) < length:
            action = policy.act(observation, rng, std, clip)
            following, reward, terminated, truncated, _ = env.step(action)
            rows.append((np.asarray(observation, dtype=np.float32), action, float(reward)))
            observation, done = following, terminated or truncated
        if len(rows) == length:
            env.close()
            reward_ = torch.tensor([row[2] for row in rows])
            info = {"reward": reward_, "ep_return": reward_.sum().expand(length).clone()}
            info |= {key: torch.zeros(length, dtype=torch.bool) for key in ("is_noise", "is_amateur")}
            info |= {key: torch.zeros(length, dtype=torch.int64) for key in ("episode", "expert")}
            data = {
                "observation": torch.from_numpy(np.stack([row[0] for row in rows])),
                "action": torch.from_numpy(np.stack([row[1] for row in rows])),
                "info": TensorDict(info, [length]),
            }
            return TensorDict(data, [length]), attempt
    raise RuntimeError(
        f"{tries} episodes from seed {seed} all ended before {length} steps: the demonstrator falls; lower std={std}"
    )


def save_demonstrations(path: str | os.PathLike[str], demonstrations: TensorDictBase, metadata: dict[str, Any]) -> None:
    """Writes demonstrations as one safetensors file, atomically.

    Args:
        path: file to write.
        demonstrations: flat ``[N]``.
        metadata: JSON-able facts about the recording.

    Raises:
        OSError: if the file cannot be written.
    """
    flat = {key: value.contiguous() for key, value in demonstrations.flatten_keys(".").items()}
    with atomic_path(path) as temporary:
        save_file(flat, temporary, {"recording": json.dumps(metadata)})


def load_demonstrations(path: str | os.PathLike[str]) -> tuple[TensorDict, dict[str, Any]]:
    """Reads what :func:`save_demonstrations` wrote.

    Args:
        path: the file.

    Returns:
        The demonstrations, ``[N]``, and the metadata.

    Raises:
        ValueError: if the file is truncated.

    Examples:
        >>> import tempfile
        >>> file = os.path.join(tempfile.mkdtemp(), "data.safetensors")
        >>> save_demonstrations(file, TensorDict({"action": torch.zeros(4, 2)}, [4]), {"std": 0.2})
        >>> data, metadata = load_demonstrations(file)
        >>> data.shape, metadata
        (torch.Size([4]), {'std': 0.2})
    """
    try:
        with safe_open(path, "pt") as handle:
            flat = {name: handle.get_tensor(name) for name in handle.keys()}  # noqa: SIM118
            metadata = json.loads((handle.metadata() or {}).get("recording", "{}"))
    except SafetensorError as error:
        raise ValueError(
            f"{str(path)!r} is truncated or no safetensors file ({error}): delete it and record again"
        ) from error
    size = len(next(iter(flat.values())))
    return TensorDict(flat, [size]).unflatten_keys("."), metadata


def validate_demonstrations(demonstrations: TensorDictBase, *, action_limit: float | None = None) -> None:
    """Checks demonstrations before anything is trained on them.

    Args:
        demonstrations: flat ``[N]`` with ``observation`` ``[N, O]`` and ``action`` ``[N, A]``.
        action_limit: largest magnitude of an action in its space. Default: not checked.

    Raises:
        KeyError: if a key is missing.
        TypeError: if the dtypes are mixed.
        ValueError: for shapes, non-finite rows, or too few samples; the message names key and rows.

    Warns:
        UserWarning: for dimensions that never change.

    Examples:
        >>> validate_demonstrations(TensorDict({"observation": torch.rand(3, 2), "action": torch.rand(3, 1)}, [3]))
    """
    size = len(demonstrations)
    if size < 2:
        raise ValueError(f"{size} samples cannot be imitated: record at least two")
    dtypes = {}
    for key in ("observation", "action"):
        value = demonstrations.get(key, None)
        if value is None:
            raise KeyError(f"the demonstrations have no {key!r}, only {sorted(map(str, demonstrations.keys()))}")
        if value.ndim != 2:
            raise ValueError(f"{key!r} has shape {list(value.shape)}, needed is [{size}, dimension]: flatten it")
        dtypes[key] = value.dtype
        bad = (~value.isfinite().all(1)).nonzero()[:, 0].tolist()
        if bad:
            raise ValueError(f"{key!r} is NaN or infinite in {len(bad)} of {size} rows, first {bad[:5]}: remove them")
        constant = (value == value[0]).all(0).nonzero()[:, 0].tolist()
        if constant:
            warnings.warn(f"{key!r} never changes in dimensions {constant}", stacklevel=2)
    if len(set(dtypes.values())) > 1:
        raise TypeError(f"mixed dtypes {dtypes}: convert the data by demonstrations.float()")
    if action_limit is not None:
        outside = (demonstrations["action"].abs() > action_limit).any(1).nonzero()[:, 0].tolist()
        if outside:
            raise ValueError(
                f"'action' is outside of [-{action_limit}, {action_limit}] in {len(outside)} of {size} rows, first "
                f"{outside[:5]}: clip the executed action, or record it in the space's units"
            )
