"""Settings of stacked members."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor


def per_member(name: str, value: Any, num_members: int | None) -> list[Any]:
    """A setting as a list with one value for each member, or with the one value where there are none.

    Args:
        name: of the setting, for the message.
        value: a number or name for all, or a sequence or tensor of one for each member.
        num_members: how many there are; None for a single policy.

    Returns:
        Numbers as floats, and names.

    Raises:
        ValueError: if the number of values is not that of the members.

    Examples:
        >>> per_member("q", 1, 2), per_member("gamma_mix", ["adaptive", 0], 2)
        ([1.0, 1.0], ['adaptive', 0.0])
    """
    values = value.tolist() if isinstance(value, Tensor) else value
    if isinstance(values, str) or not isinstance(values, Sequence):
        values = [values] * (num_members or 1)
    elif len(values) != num_members:
        raise ValueError(
            f"{name} has {len(values)} values for {num_members or 1} policies: give a number or one of each"
        )
    return [x if isinstance(x, str) else float(x) for x in values]
