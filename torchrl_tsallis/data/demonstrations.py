"""Recording of demonstrations, their storage, and the checks that bad data fails early."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from tensordict import TensorDict, TensorDictBase

from torchrl_tsallis._checks import check_callable, check_flag, check_number, check_path, check_seed, shown
from torchrl_tsallis.data.episodes import find_episodes, has_episodes
from torchrl_tsallis.data.policy import NumpyPolicy
from torchrl_tsallis.data.schema import check_layout, check_pairs
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
    check_callable("make_env", make_env, "makes the environment")
    if not callable(getattr(policy, "act", None)):
        raise TypeError(f"policy must be a NumpyPolicy, such as load_policy('expert_0'), got {shown(policy)}")
    std, seed, clip = check_number("std", std, low=0), check_seed("seed", seed, low=0), check_flag("clip", clip)
    length = int(check_number("length", length, low=1, integer=True))
    tries = int(check_number("tries", tries, low=1, integer=True))
    env = make_env()
    if not hasattr(env, "reset"):
        raise TypeError(f"make_env must make an environment of gymnasium, it made {shown(env)}")
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
        TypeError: if the metadata is nothing that JSON can hold.
        ValueError: if the demonstrations are not ``[N]``, or a key has a dot, by which the file would nest it.
    """
    path = check_path("path", path)
    check_layout(demonstrations)
    try:
        recording = json.dumps(metadata)
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"the metadata of {str(path)!r} is not JSON-able ({error}): convert it to plain numbers"
        ) from error
    found = dict(demonstrations.flatten_keys(".").items())
    for key, value in found.items():
        if not isinstance(value, torch.Tensor):
            raise TypeError(
                f"{key!r} of the demonstrations is {shown(value)}, needed are tensors: put it in the metadata"
            )
    flat = {key: value.contiguous() for key, value in found.items()}
    with atomic_path(path) as temporary:
        save_file(flat, temporary, {"recording": recording})


def load_demonstrations(path: str | os.PathLike[str]) -> tuple[TensorDict, dict[str, Any]]:
    """Reads what :func:`save_demonstrations` wrote.

    Args:
        path: the file.

    Returns:
        The demonstrations, ``[N]``, and the metadata.

    Raises:
        FileNotFoundError: if it is not there.
        OSError: if it cannot be read.
        ValueError: if it is truncated, or holds something other than rows; the message names the file.

    Examples:
        >>> import tempfile
        >>> file = os.path.join(tempfile.mkdtemp(), "data.safetensors")
        >>> save_demonstrations(file, TensorDict({"action": torch.zeros(4, 2)}, [4]), {"std": 0.2})
        >>> data, metadata = load_demonstrations(file)
        >>> data.shape, metadata
        (torch.Size([4]), {'std': 0.2})
    """
    path = check_path("path", path)
    name = repr(path)
    try:
        with safe_open(path, "pt") as handle:
            flat = {key: handle.get_tensor(key) for key in handle.keys()}  # noqa: SIM118
            recording = (handle.metadata() or {}).get("recording", "{}")
    except FileNotFoundError as error:
        raise FileNotFoundError(error.errno, f"{name} is not there: record it, or give its path") from error
    except SafetensorError as error:
        raise ValueError(f"{name} is truncated or no safetensors file ({error}): delete it and record again") from error
    except OSError as error:
        raise OSError(error.errno, f"cannot read {name} ({error}): check its permissions") from error
    try:
        metadata = json.loads(recording)
    except ValueError as error:
        raise ValueError(f"the metadata of {name} is no JSON ({error}): save the demonstrations again") from error
    if not isinstance(metadata, dict):
        raise ValueError(f"the metadata of {name} is {type(metadata).__name__}, needed is an object: save it again")
    if not flat:
        raise ValueError(f"{name} holds no tensor: record again")
    scalars = sorted(key for key, value in flat.items() if not value.ndim)
    if scalars:
        raise ValueError(f"{scalars[0]!r} of {name} is a scalar, needed is one entry a row: save it as metadata")
    lengths = {key: len(value) for key, value in sorted(flat.items())}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"the entries of {name} have unequal lengths, {lengths}: they are no rows; record again")
    size = next(iter(lengths.values()))
    try:
        return TensorDict(flat, [size]).unflatten_keys("."), metadata
    except (KeyError, RuntimeError, ValueError) as error:
        raise ValueError(f"the keys {sorted(flat)} of {name} nest into each other: rename one") from error


def validate_demonstrations(demonstrations: TensorDictBase, *, action_limit: float | None = None) -> None:
    """Checks demonstrations before anything is trained on them.

    Args:
        demonstrations: flat ``[N]`` with ``observation`` and ``action``, see :mod:`torchrl_tsallis.data.schema`:
            vectors ``[N, D]``, integers ``[N]``, images, or nested tensordicts of these.
        action_limit: largest magnitude of an action in its space. Default: not checked.

    Raises:
        KeyError: if a key is missing.
        TypeError: if the floating-point dtypes are mixed, or an entry is no tensor of real numbers.
        ValueError: for shapes, non-finite rows, too few samples, or ends of episodes that contradict each other; the
            message names key and rows.

    Warns:
        UserWarning: for dimensions of vectors that never change. A logged notice says where data is float64.

    Examples:
        >>> validate_demonstrations(TensorDict({"observation": torch.rand(3, 2), "action": torch.rand(3, 1)}, [3]))
    """
    if action_limit is not None:
        action_limit = float(check_number("action_limit", action_limit, above=0))
    check_pairs(demonstrations, action_limit=action_limit)
    if has_episodes(demonstrations):
        find_episodes(demonstrations, open_end=True)
