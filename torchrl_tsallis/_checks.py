"""One check of numbers for every setting: what is wanted, and what was given."""

from __future__ import annotations

import math
from numbers import Integral, Real
from typing import Any


def check_number(
    name: str,
    value: Any,
    *,
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    below: float | None = None,
    integer: bool = False,
    finite: bool = True,
) -> float | int:
    """Refuses what is no number, or one outside of its range.

    Args:
        name: of the setting, for the message.
        value: a Python or NumPy number, or a tensor or array of one element; truth values are refused.
        low: the least value.
        high: the largest one.
        above: what the value must exceed.
        below: what it must stay below.
        integer: whether it must be a whole number; 2.0 is one of type float, and refused.
        finite: whether infinity is refused. NaN always is.

    Returns:
        The value as an int or a float of Python.

    Raises:
        TypeError: if it is no number, or none of the kind that is wanted.
        ValueError: if it is outside of the range.

    Examples:
        >>> check_number("lr", 1e-3, above=0)
        0.001
        >>> check_number("steps", 2.5, low=1, integer=True)
        Traceback (most recent call last):
        ...
        TypeError: steps must be an integer of at least 1, got 2.5
        >>> check_number("clip_norm", -1, above=0)
        Traceback (most recent call last):
        ...
        ValueError: clip_norm must be a finite number above 0, got -1
    """
    bounds = (("of at least", low), ("above", above), ("of at most", high), ("below", below))
    wanted = " and ".join(f"{word} {bound}" for word, bound in bounds if bound is not None)
    kind = "an integer" if integer else "a finite number" if finite else "a number"
    message = f"{name} must be {kind}{' ' * bool(wanted)}{wanted}, got {value!r}"
    number = value
    if hasattr(value, "numel") or hasattr(value, "ndim"):  # tensors and arrays
        if math.prod(value.shape) != 1:
            raise TypeError(f"{message} of shape {tuple(value.shape)}")
        number = value.item()
    if isinstance(number, bool) or not isinstance(number, Integral if integer else Real):
        raise TypeError(message)
    number = int(number) if isinstance(number, Integral) else float(number)
    try:
        size = float(number)
    except OverflowError:  # an integer beyond the floats
        size = 0.0 if integer else math.inf
    inside = (
        (low is None or number >= low)
        and (high is None or number <= high)
        and (above is None or number > above)
        and (below is None or number < below)
    )
    if math.isnan(size) or (finite and math.isinf(size)) or not inside:
        raise ValueError(message)
    return number
