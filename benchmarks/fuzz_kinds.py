"""What the fuzz knows of arguments: which values may be given, read from a signature, and which are tried."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from numbers import Integral, Real
from typing import Any

import numpy as np
import torch
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor, nn

Allowed = Callable[[Any], bool]

#: Arguments of type float that may be negative, or infinite.
SIGNED = {"mean", "turned", "low", "high", "target_entropy"}
INFINITE = {"k", "ini_dof"}


def plain(value: Any) -> Any:
    """A number of NumPy or torch as Python's."""
    one = isinstance(value, (Tensor, np.ndarray, np.generic)) and math.prod(value.shape) == 1
    return value.item() if one else value


def number(name: str, low: float = 0, high: float = math.inf) -> Allowed:
    """Finite numbers, not negative but for the names that may be."""
    low = -math.inf if name in SIGNED else low

    def allowed(value: Any) -> bool:
        value = plain(value)
        if not isinstance(value, Real) or isinstance(value, bool) or value != value:
            return False
        try:
            finite = math.isfinite(float(value))
        except OverflowError:
            finite = False
        return (finite or name in INFINITE) and low <= value <= high

    return allowed


def whole(name: str) -> Allowed:
    """Integers, of any sign for seeds and not negative for others."""

    def allowed(value: Any) -> bool:
        value = plain(value)
        return isinstance(value, Integral) and not isinstance(value, bool) and ("seed" in name or value >= 0)

    return allowed


def flag(value: Any) -> bool:
    """Truth values."""
    return isinstance(plain(value), bool)


def text(value: Any) -> bool:
    """Strings."""
    return isinstance(value, str)


def path(value: Any) -> bool:
    """Paths that can be one."""
    return isinstance(value, (str, os.PathLike)) and str(value) != "" and "\0" not in str(value)


def key(value: Any) -> bool:
    """Keys of a tensordict."""
    parts = value if isinstance(value, tuple) else (value,)
    return bool(parts) and all(isinstance(part, str) and part for part in parts)


def anything(value: Any) -> bool:
    """All."""
    return True


def several(one: Allowed) -> Allowed:
    """Sequences of what is allowed."""

    def allowed(value: Any) -> bool:
        listed = value.tolist() if isinstance(value, (Tensor, np.ndarray)) else value
        return isinstance(listed, Sequence) and not isinstance(listed, (str, bytes)) and all(map(one, listed))

    return allowed


def named(name: str) -> Allowed:
    """Objects of a class of that name, or one below it."""
    return lambda value: any(kind.__name__ == name for kind in type(value).__mro__)


def parts_of(annotation: str) -> list[str]:
    """The alternatives of ``A | B[C | D]``."""
    found, depth = [""], 0
    for sign in annotation:
        depth += (sign == "[") - (sign == "]")
        if sign == "|" and not depth:
            found.append("")
        else:
            found[-1] += sign
    return [part.strip() for part in found]


def kind_of(name: str, annotation: Any) -> Allowed:
    """What an argument's annotation allows; all where it says nothing that can be checked."""
    kinds = [_one(name, part) for part in parts_of(annotation if isinstance(annotation, str) else "Any")]
    return lambda value: any(kind(value) for kind in kinds)


def _one(name: str, part: str) -> Allowed:
    simple = {
        "float": number(name),
        "int": whole(name),
        "bool": flag,
        "str": text,
        "NestedKey": key,
        "None": lambda value: value is None,
        "torch.dtype": lambda value: isinstance(value, torch.dtype) and value.is_floating_point,
    }
    if part in simple:
        return path if part == "str" and name.endswith(("path", "dir", "folder")) else simple[part]
    if part.startswith("os.PathLike"):
        return path
    if part.startswith(("Callable", "MakeOptimizer", "MakeSchedule", "EnvFn")):
        return callable
    if part.startswith("Literal"):
        choices = re.findall(r"'([^']*)'|\"([^\"]*)\"", part)
        return lambda value: isinstance(value, str) and value in {a or b for a, b in choices}
    if part.startswith("Sequence["):
        return several(kind_of(name, part[9:-1]))
    if re.fullmatch(r"[\w.]+", part) and part not in (
        "Any",
        "ArrayLike",
        "Level",
        "Settings",
        "Kind",
        "TensorDictBase",
    ):
        return named(part.split(".")[-1])
    return (lambda value: isinstance(value, (TensorDict, Mapping))) if part == "TensorDictBase" else anything


# What is tried. Integers between a few and astronomically many are left out: they are allowed, and take memory or time.
_INTEGERS = [-(2**63), -(10**30), -2, -1, 0, 1, 2, 3, 2**62, 2**64, 10**30, 10**400]
_FLOATS = [math.nan, math.inf, -math.inf, -1.0, -0.0, 0.0, 5e-324, 0.3, 1.0, 2.0, 2.5, 1e308, -1e308]
_TEXTS = ["", " ", "1", "1e-3", "nan", "inf", "auto", "none", "a.b", "../x", "a\0b", "/proc/nowhere/x", "é" * 300]
_OTHERS: list[Callable[[], Any]] = [
    lambda: None, lambda: True, lambda: False, lambda: 1j, lambda: b"1", lambda: {}, lambda: {"a": 1}, lambda: set(),
    lambda: [], lambda: (), lambda: [None], lambda: [0.5, math.nan], lambda: [0.5, 0.5], lambda: [-1, 2], lambda: ["a"],
    lambda: [[1.0]], lambda: ("a", 1), lambda: ("a", ""), lambda: [True, False], lambda: range(2), lambda: object(),
    lambda: object, lambda: len, lambda: (lambda *a, **k: None), lambda: iter([1.0]), lambda: Ellipsis,
    lambda: torch.tensor(0.5), lambda: torch.tensor(math.nan), lambda: torch.tensor([]), lambda: torch.ones(2, 3),
    lambda: torch.tensor([0.5, math.inf]), lambda: torch.tensor(1), lambda: torch.tensor(True), lambda: torch.float32,
    lambda: torch.int64, lambda: np.float64(0.5), lambda: np.int64(-1), lambda: np.array([1, 2]), lambda: np.array("a"),
    lambda: np.array([]), lambda: nn.Linear(2, 2), lambda: nn.Parameter(torch.zeros(2)), lambda: TensorDict({}, []),
    lambda: TensorDict({}, [0]), lambda: TensorDict({"a": torch.ones(3)}, [3]), lambda: np.datetime64("2020-01-01"),
]  # fmt: skip


def values() -> st.SearchStrategy[Any]:
    """Anything: by kinds in turn, so that few examples have some of each."""
    return st.one_of(
        st.sampled_from(_OTHERS).map(lambda make: make()),
        st.sampled_from(_FLOATS),
        st.sampled_from(_INTEGERS),
        st.sampled_from(_TEXTS),
        st.floats(),
        st.text(max_size=4),
        st.lists(st.sampled_from([*_FLOATS, *_INTEGERS, None, "a", True]), max_size=3),
    )
