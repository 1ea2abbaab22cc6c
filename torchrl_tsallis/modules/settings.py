"""Checks of the settings of networks."""

from __future__ import annotations

from typing import Any

from torchrl_tsallis._checks import check_number


def check_dims(**dims: Any) -> None:
    """Raises TypeError for a dimension that is no integer, and ValueError for one that is not positive."""
    if min(check_number(name, value, integer=True) for name, value in dims.items()) < 1:
        raise ValueError(f"every dimension must be positive, got {', '.join(f'{n}={v}' for n, v in dims.items())}")


def check_key(name: str, key: Any) -> None:
    """Raises TypeError or ValueError for what is no key of a tensordict."""
    parts = key if isinstance(key, tuple) else (key,)
    if not all(isinstance(part, str) for part in parts):
        raise TypeError(f"{name} must be a key of a tensordict, a string or a tuple of them, got {key!r}")
    if not parts or "" in parts:
        raise ValueError(f"{name} must be a key of a tensordict, got the empty {key!r}")
