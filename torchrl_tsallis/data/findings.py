"""What a check of demonstrations found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_tsallis.data.schema import leaves

#: Rows, dimensions or episodes that a finding names; ``count`` says how many there are.
NAMED = 20


@dataclass(frozen=True)
class Finding:
    """A fault, or what may be one.

    Args:
        severity: ``"error"``, training fails or learns from wrong rows; ``"warning"``, look at it; ``"note"``.
        kind: name of the check.
        what: what was found, in a sentence.
        fix: what to do about it.
        key: the entry.
        count: number of rows, dimensions or episodes concerned.
        rows: the first rows.
        dimensions: the first dimensions.
        episodes: the first episodes, by their place in the data.
    """

    severity: Literal["error", "warning", "note"]
    kind: str
    what: str
    fix: str
    key: str = ""
    count: int = 0
    rows: tuple[int, ...] = ()
    dimensions: tuple[int, ...] = ()
    episodes: tuple[int, ...] = ()

    @property
    def where(self) -> str:
        """The entry, rows, dimensions and episodes, for people."""
        parts = [repr(self.key)] if self.key else []
        for name in ("dimensions", "episodes", "rows"):
            values = getattr(self, name)
            if values:
                more = ", ..." if len(values) == NAMED else ""
                parts.append(f"{name} {', '.join(map(str, values))}{more}")
        return "; ".join(parts)

    def to_json(self) -> dict[str, Any]:
        """The same as a dictionary that ``json`` can write."""
        return asdict(self) | {"where": self.where}


def named(values: Tensor | Sequence[int]) -> tuple[int, ...]:
    """The first few as a tuple."""
    return tuple(int(value) for value in values[:NAMED])


def text(key: NestedKey) -> str:
    """A key with dots."""
    return key if isinstance(key, str) else ".".join(key)


def vectors(demonstrations: TensorDictBase, keys: Sequence[NestedKey]) -> dict[NestedKey, Tensor]:
    """The floating-point vectors ``[N, D]`` under the keys; images, choices and flags are left out."""
    found = leaves(demonstrations, keys)
    return {key: value for key, value in found.items() if value.ndim == 2 and value.is_floating_point()}


def within(lengths: Tensor) -> Tensor:
    """Rows whose following row belongs to the same episode, ``[N - 1]`` bool."""
    inside = torch.ones(int(lengths.sum()), dtype=torch.bool)
    inside[lengths.cumsum(0) - 1] = False
    return inside[:-1]
