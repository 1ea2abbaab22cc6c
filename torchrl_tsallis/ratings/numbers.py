"""Settings of ratings as numbers: one, or one for each stacked member."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Real
from typing import Any

import numpy as np
from torch import Tensor

from torchrl_tsallis._checks import shown


def _within(x: Any, low: float, high: float) -> bool:
    """Whether a number is in [low, high]; integers beyond the floats are compared as they are."""
    return low <= x <= high


def as_numbers(name: str, value: Any, low: float, high: float) -> float | list[float]:
    """A setting as a number in [low, high], or a list of them.

    Args:
        name: for the message.
        value: a number, or a sequence or tensor of numbers.
        low: the least that is allowed.
        high: the largest that is allowed.

    Returns:
        A float, or a list of floats.

    Raises:
        ValueError: for anything else, NaN included.

    Examples:
        >>> as_numbers("q", [1, 0.5], 0, 1)
        [1.0, 0.5]
        >>> as_numbers("q", None, 0, 1)
        Traceback (most recent call last):
        ...
        ValueError: q must be a number in [0, 1], or a sequence of one for each stacked member, got None
    """
    plain: Any = value.tolist() if isinstance(value, (Tensor, np.ndarray)) else value
    many = isinstance(plain, Sequence) and not isinstance(plain, str)
    numbers: list[Any] = list(plain) if many else [plain]
    valid = [isinstance(x, Real) and not isinstance(x, bool) and _within(x, low, high) for x in numbers]
    if numbers and all(valid):
        return [float(x) for x in numbers] if many else float(plain)
    raise ValueError(
        f"{name} must be a number in [{low:g}, {high:g}], or a sequence of one for each stacked member, got "
        f"{shown(value)}"
    )
