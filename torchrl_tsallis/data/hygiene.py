"""Faults of demonstrations that can be seen without training: values, copies, stretches, boundaries, times.

Each check is a function of the data that gives findings; :func:`inspect_demonstrations` runs all. None of them says
whether a demonstration is good.
"""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Real
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_tsallis._checks import check_number, shown
from torchrl_tsallis.data.episodes import find_episodes, has_episodes
from torchrl_tsallis.data.findings import Finding, named, text, vectors
from torchrl_tsallis.data.hygiene_steps import find_boundaries, find_copies, find_lengths, find_still, find_time_jumps
from torchrl_tsallis.data.robust_scaling import ROUNDINGS
from torchrl_tsallis.data.rows import pieces, row_bytes
from torchrl_tsallis.data.schema import bad_rows, check_layout, leaves

_KEYS: tuple[NestedKey, ...] = ("observation", "action")


def find_non_finite(demonstrations: TensorDictBase, keys: Sequence[NestedKey] = _KEYS) -> list[Finding]:
    """Rows that are NaN or infinite.

    Examples:
        >>> from tensordict import TensorDict
        >>> data = TensorDict({"observation": torch.zeros(3, 1), "action": torch.tensor([[0], [torch.nan], [0]])}, [3])
        >>> find_non_finite(data)[0].where
        "'action'; rows 1"
    """
    out = []
    for key, value in leaves(demonstrations, keys).items():
        count, first = bad_rows(value)
        if count:
            what = f"{text(key)!r} is NaN or infinite in {count} of {len(value)} rows"
            out.append(
                Finding("error", "non_finite", what, "remove the rows' episodes", text(key), count, named(first))
            )
    return out


def _extremes(value: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Least and greatest of each dimension, and the shares of rows that are exactly there, each ``[D]``."""
    least, most = value[0].clone(), value[0].clone()
    parts = list(pieces(len(value), row_bytes(value)))
    for part in parts:
        least, most = torch.minimum(least, value[part].amin(0)), torch.maximum(most, value[part].amax(0))
    low, high = torch.zeros(value.shape[1]), torch.zeros(value.shape[1])
    for part in parts:
        low += (value[part] == least).sum(0)
        high += (value[part] == most).sum(0)
    return least, most, low / len(value), high / len(value)


def find_constant(demonstrations: TensorDictBase, keys: Sequence[NestedKey] = _KEYS) -> list[Finding]:
    """Dimensions that never change, or only by rounding (64 roundings of float32)."""
    out = []
    for key, value in vectors(demonstrations, keys).items():
        least, most, _, _ = _extremes(value)
        still = (most - least <= ROUNDINGS * torch.maximum(least.abs(), most.abs())).nonzero()[:, 0]
        if len(still):
            what = f"{text(key)!r} does not move in {len(still)} of {value.shape[1]} dimensions"
            fix = "leave them out, or check that they were recorded; RobustScaling only centres them"
            out.append(
                Finding("warning", "constant", what, fix, text(key), len(still), dimensions=named(still.tolist()))
            )
    return out


def find_saturated(
    demonstrations: TensorDictBase, keys: Sequence[NestedKey] = ("action",), *, share: float = 0.05
) -> list[Finding]:
    """Dimensions that stand exactly at their least or greatest value in many rows, as commands at a limit do.

    Dimensions of two values, such as a gripper's, are none.

    Args:
        demonstrations: flat ``[N]``.
        keys: entries to look at.
        share: of the rows at one of the ends, from which on it is one (0.05).
    """
    out = []
    for key, value in vectors(demonstrations, keys).items():
        least, most, low, high = _extremes(value)
        ends = torch.maximum(low, high)
        found = ((ends >= share) & (low + high < 0.95) & (least < most) & (ends * len(value) >= 2)).nonzero()[:, 0]
        if len(found):
            what = (
                f"{text(key)!r} stands at its limit in {len(found)} of {value.shape[1]} dimensions, most in "
                f"{100 * float(ends[found].max()):.0f} % of the rows"
            )
            fix = "record the command before it is clipped: a density has no bound where values pile up"
            out.append(
                Finding("warning", "saturated", what, fix, text(key), len(found), dimensions=named(found.tolist()))
            )
    return out


def find_outside(demonstrations: TensorDictBase, *, low: float | Tensor, high: float | Tensor) -> list[Finding]:
    """Rows whose action is outside of its space.

    Args:
        demonstrations: flat ``[N]`` with a floating-point ``action`` ``[N, A]``.
        low: least action, a number or ``[A]``.
        high: greatest action, a number or ``[A]``.
    """
    out = []
    for key, value in vectors(demonstrations, ["action"]).items():
        count = 0
        first: list[int] = []
        dimensions = torch.zeros(value.shape[1], dtype=torch.bool)
        for part in pieces(len(value), row_bytes(value)):
            outside = (value[part] < low) | (value[part] > high)
            rows = outside.any(1).nonzero()[:, 0]
            dimensions |= outside.any(0)
            count += len(rows)
            first += (part.start + rows[: max(0, 20 - len(first))]).tolist()
        if count:
            what = f"{text(key)!r} is outside of its space in {count} of {len(value)} rows"
            fix = "clip the executed action, or record it in the space's units"
            where = dimensions.nonzero()[:, 0].tolist()
            out.append(Finding("warning", "outside", what, fix, text(key), count, named(first), named(where)))
    return out


def _check_tensor(name: str, value: Any, size: int | None) -> None:
    """Raises for what are no real numbers without NaN; of ``size`` rows each has to have one."""
    number = isinstance(value, Real) and not isinstance(value, bool) and size is None
    tensor = isinstance(value, Tensor) and not value.is_complex() and value.dtype != torch.bool and value.numel() > 0
    if not number and not tensor:
        wanted = "a number or a tensor [A]" if size is None else "a tensor [N]"
        raise TypeError(f"{name} must be {wanted}, got {shown(value)}")
    if number:
        check_number(name, value)
    elif bool(value.isnan().any()):
        raise ValueError(f"{name} must have no NaN, got {shown(value)}")
    elif size is not None and value.numel() != size:
        raise ValueError(f"{value.numel()} {name} for {size} rows: give one a row")


def inspect_demonstrations(
    demonstrations: TensorDictBase,
    *,
    low: float | Tensor | None = None,
    high: float | Tensor | None = None,
    timestamps: Tensor | None = None,
) -> list[Finding]:
    """Runs all checks; the worst findings come first.

    Args:
        demonstrations: flat ``[N]``, see :mod:`torchrl_tsallis.data.schema`.
        low: least action. Default: not checked.
        high: greatest action. Default: not checked.
        timestamps: in s, ``[N]``. Default: ``("info", "timestamp")`` where there is one.

    Returns:
        The findings. What holds NaN is left out of the other checks.

    Raises:
        KeyError: if observation or action are missing.
        TypeError: if they are no tensors of real numbers.
        ValueError: if there is no row.

    Examples:
        >>> from tensordict import TensorDict
        >>> rows = {"observation": torch.zeros(4, 1), "action": torch.rand(4, 1), "episode": torch.tensor([0, 0, 0, 1])}
        >>> [finding.kind for finding in inspect_demonstrations(TensorDict(rows, [4]))]
        ['constant', 'length_one']
    """
    size = check_layout(demonstrations)
    if not size:
        raise ValueError("the demonstrations are empty: there is no row")
    for name, value in (("low", low), ("high", high), ("timestamps", timestamps)):
        if value is not None:
            _check_tensor(name, value, size if name == "timestamps" else None)
    out = find_non_finite(demonstrations)
    broken = {finding.key for finding in out}
    finite = [key for key in leaves(demonstrations, _KEYS) if text(key) not in broken]
    actions = [key for key in finite if text(key).split(".")[0] == "action"]
    observations = [key for key in finite if key not in actions]
    out += find_constant(demonstrations, finite) + find_saturated(demonstrations, actions)
    if low is not None and high is not None and actions:
        out += find_outside(demonstrations, low=low, high=high)
    episodes = None
    if has_episodes(demonstrations):
        try:
            episodes = find_episodes(demonstrations, open_end=True)
        except ValueError as error:
            out.append(Finding("error", "episodes", str(error), "correct the flags or the episodes' numbers"))
    out += find_copies(demonstrations, finite, episodes)
    if episodes is not None:
        out += find_lengths(episodes)
        out += find_still(demonstrations, observations, episodes) + find_boundaries(
            demonstrations, observations, episodes
        )
        times = timestamps if timestamps is not None else demonstrations.get(("info", "timestamp"), None)
        if times is not None:
            out += find_time_jumps(times, episodes)
    order = {"error": 0, "warning": 1, "note": 2}
    return sorted(out, key=lambda finding: order[finding.severity])
