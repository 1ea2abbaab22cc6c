"""One check for every kind of setting: what is wanted, and what was given."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from numbers import Integral, Real
from typing import Any


def shown(value: Any) -> str:
    """A value as a message names it: in one line, and not a page of it.

    Examples:
        >>> shown("a" * 100)
        "'aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa..."
    """
    try:
        text = " ".join(repr(value).split())
    except Exception:  # whatever the object's own code raises
        text = f"a {type(value).__name__}"
    return text if len(text) <= 80 else f"{text[:77]}..."


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
    message = f"{name} must be {kind}{' ' * bool(wanted)}{wanted}, got {shown(value)}"
    number = value
    if hasattr(value, "shape"):  # tensors and arrays
        if not hasattr(value, "item") or math.prod(value.shape) != 1:
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


def check_seed(name: str, value: Any, *, low: int = -(2**63)) -> int:
    """Refuses what seeds no generator of random numbers.

    Args:
        name: of the setting, for the message.
        value: an integer of 64 bits.
        low: the least one: NumPy's generators take no negative seed, torch's do.

    Returns:
        The seed as an int.

    Raises:
        TypeError: if it is no integer.
        ValueError: if it is outside of the range.

    Examples:
        >>> check_seed("seed", None)
        Traceback (most recent call last):
        ...
        TypeError: seed must be an integer, got None
    """
    number = check_number(name, value, integer=True)
    if not low <= number < 2**63:
        kind = "a non-negative integer" if low == 0 else "an integer"
        raise ValueError(f"{name} must be {kind} of 64 bits, got {shown(value)}")
    return int(number)


def check_flag(name: str, value: Any) -> bool:
    """Refuses what is no truth value: ``"no"`` would count as true.

    Examples:
        >>> check_flag("clip", "no")
        Traceback (most recent call last):
        ...
        TypeError: clip must be True or False, got 'no'
    """
    if not isinstance(value, bool) and type(value).__name__ not in ("bool", "bool_"):  # Python's and NumPy's
        raise TypeError(f"{name} must be True or False, got {shown(value)}")
    return bool(value)


def check_text(name: str, value: Any) -> str:
    """Refuses what is no string."""
    if not isinstance(value, str):
        raise TypeError(f"{name} must be a string, got {shown(value)}")
    return value


def check_choice(name: str, value: Any, choices: Sequence[str]) -> str:
    """Refuses what is none of some names.

    Examples:
        >>> check_choice("reduction", "max", ("mean", "sum"))
        Traceback (most recent call last):
        ...
        ValueError: reduction must be 'mean' or 'sum', got 'max'
    """
    if not isinstance(value, str) or value not in choices:
        *others, last = map(repr, choices)
        raise ValueError(f"{name} must be {', '.join(others)}{' or ' * bool(others)}{last}, got {shown(value)}")
    return value


def check_path(name: str, value: Any) -> str:
    """Refuses what is no path of a file or folder.

    Returns:
        The path as a string.

    Raises:
        TypeError: if it is neither a string nor a ``pathlib.Path``.
        ValueError: if it is empty or has a NUL.

    Examples:
        >>> check_path("checkpoint_dir", "")
        Traceback (most recent call last):
        ...
        ValueError: checkpoint_dir must be the path of a file or folder, got ''
    """
    message = f"{name} must be the path of a file or folder, got {shown(value)}"
    if not isinstance(value, (str, os.PathLike)) or not isinstance(os.fspath(value), str):
        raise TypeError(message)
    path = str(os.fspath(value))
    if not path or "\0" in path:
        raise ValueError(message)
    return path


def check_callable(name: str, value: Any, what: str) -> None:
    """Raises TypeError for what cannot be called; ``what`` says what it is called for."""
    if not callable(value):
        raise TypeError(f"{name} must be a callable that {what}, got {shown(value)}")


def check_instance(name: str, value: Any, kinds: type | tuple[type, ...], what: str) -> None:
    """Raises TypeError for what is of no such class; ``what`` says which object is wanted, and how it is made."""
    if not isinstance(value, kinds):
        raise TypeError(f"{name} must be {what}, got {shown(value)}")


def check_keys(name: str, value: Any) -> list[Any]:
    """Refuses what is no sequence of keys of a tensordict.

    Returns:
        The keys as a list.

    Raises:
        TypeError: if it is no sequence of strings and tuples of strings; a single string is none.
        ValueError: if there is none, or one is empty.

    Examples:
        >>> check_keys("keys", "action")
        Traceback (most recent call last):
        ...
        TypeError: keys must be a sequence of keys of a tensordict, such as ['observation', 'action'], got 'action'
    """
    message = (
        f"{name} must be a sequence of keys of a tensordict, such as ['observation', 'action'], got {shown(value)}"
    )
    if isinstance(value, (str, bytes, Mapping)) or not isinstance(value, (Sequence, set, frozenset)):
        raise TypeError(message)
    keys = list(value)
    for key in keys:
        parts: Iterable[Any] = key if isinstance(key, tuple) else (key,)
        if not all(isinstance(part, str) for part in parts):
            raise TypeError(message)
        if key in ((), "") or "" in parts:
            raise ValueError(message)
    if not keys:
        raise ValueError(message)
    return keys
