"""Checks of settings, made before anything runs."""

from __future__ import annotations

import math
import numbers
from typing import Any

from torchrl_tsallis._checks import shown


def whole_number(name: str, value: Any, least: int) -> int:
    """Checks a whole number.

    Args:
        name: of the setting, for the message.
        value: what was given; a bool is no number.
        least: smallest one that is allowed.

    Returns:
        The number as an int.

    Raises:
        ValueError: if it is none or too small; the message names setting and value.

    Examples:
        >>> whole_number("episodes", 2.5, 1)
        Traceback (most recent call last):
        ...
        ValueError: episodes must be a whole number of at least 1, got episodes=2.5
    """
    if isinstance(value, bool) or not isinstance(value, numbers.Integral) or not least <= int(value) < 2**63:
        raise ValueError(f"{name} must be a whole number of at least {least}, got {name}={shown(value)}")
    return int(value)


def positive_number(name: str, value: Any) -> float:
    """Checks a positive, finite number.

    Args:
        name: of the setting, for the message.
        value: what was given; a bool is no number.

    Returns:
        The number as a float.

    Raises:
        ValueError: if it is none, not positive, NaN or infinite; the message names setting and value.

    Examples:
        >>> positive_number("fps", float("nan"))
        Traceback (most recent call last):
        ...
        ValueError: fps must be a positive number, got fps=nan
    """
    good = isinstance(value, numbers.Real) and not isinstance(value, bool)
    try:
        number = float(value) if good else math.nan
    except OverflowError:  # an integer beyond the floats
        number = math.inf
    if not 0 < number < math.inf:
        raise ValueError(f"{name} must be a positive number, got {name}={shown(value)}")
    return number
