"""Checks of the settings of networks."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from torchrl_tsallis._checks import check_number, shown


def check_dims(**dims: Any) -> None:
    """Raises TypeError for a dimension that is no integer, and ValueError for one that is not positive."""
    if min(check_number(name, value, integer=True) for name, value in dims.items()) < 1:
        raise ValueError(f"every dimension must be positive, got {', '.join(f'{n}={v}' for n, v in dims.items())}")


def check_key(name: str, key: Any) -> None:
    """Raises TypeError or ValueError for what is no key of a tensordict."""
    parts = key if isinstance(key, tuple) else (key,)
    if not all(isinstance(part, str) for part in parts):
        raise TypeError(f"{name} must be a key of a tensordict, a string or a tuple of them, got {shown(key)}")
    if not parts or "" in parts:
        raise ValueError(f"{name} must be a key of a tensordict, got the empty {key!r}")


@contextmanager
def memory_for(**dims: Any) -> Iterator[None]:
    """Makes torch's error about dimensions too large for the memory one that names them.

    Args:
        **dims: what the module inside is made of, by name; checked already.

    Raises:
        ValueError: if it cannot be made.

    Examples:
        >>> import torch
        >>> with memory_for(obs_dim=2**62):
        ...     torch.empty(2**62)
        Traceback (most recent call last):
        ...
        ValueError: no memory for a module of obs_dim=4611686018427387904: choose smaller dimensions
    """
    try:
        yield
    except (RuntimeError, TypeError, ValueError, OverflowError, MemoryError) as error:
        text = str(error).lower()
        if not any(word in text for word in ("memory", "overflow", "unpack", "storage size", "too large", "too big")):
            raise
        named = ", ".join(f"{name}={shown(value)}" for name, value in dims.items())
        raise ValueError(f"no memory for a module of {named}: choose smaller dimensions") from error
