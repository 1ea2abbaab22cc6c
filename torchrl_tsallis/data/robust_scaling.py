"""Scaling by medians and interquartile ranges, which neither units nor outliers change."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_tsallis._checks import check_keys, shown
from torchrl_tsallis.data.rows import map_rows, pieces, row_bytes
from torchrl_tsallis.data.scaling import ROUNDINGS
from torchrl_tsallis.data.schema import check_rows

#: Rows of which quantiles are taken; of longer data so many, evenly spread.
SAMPLE = 2**17
#: Lower and upper quantile, and the width of the range between them for a normal of deviation 1.
RANGES = ((0.25, 0.75, 1.34898), (0.05, 0.95, 3.28971), (0.01, 0.99, 4.65270))
#: A range so many times narrower than the next is that of a rest position.
IDLE = 100.0


def robust_statistics(value: Tensor) -> tuple[Tensor, Tensor]:
    r"""Centre and scale of each dimension of ``[N, D]``, in float64.

    The centre is the median. The scale is the first of these that is a signal, each divided by what it is for a normal
    of deviation 1, so that all of them are standard deviations of a normal:

    1. the interquartile range (/ 1.349);
    2. the range from the 5 % to the 95 % quantile (/ 3.290), for dimensions that rest most of the time, such as a
       gripper;
    3. the range from the 1 % to the 99 % quantile (/ 4.653);
    4. the standard deviation, for what moves in less than a hundredth of the rows;
    5. 1, for what never moves: it is only centred.

    A range is a signal if its scale is more than 64 float32 roundings of the values at its ends, and not more than 100
    times narrower than the next range (a rest position with noise). A deviation is one if the furthest row is 512
    roundings away. A scale of less than a billionth of the other dimensions' median one is taken for numerical noise
    about zero, and becomes 1. Multiplying the data, or adding to it, multiplies and
    adds to centre and scale alike, up to rounding, except in 5.

    Args:
        value: ``[N, D]``, finite.

    Returns:
        Centre and scale, each ``[D]``.

    Examples:
        >>> value = torch.tensor([[0.0, 7.0], [1.0, 7.0], [2.0, 7.0], [3.0, 7.0], [100.0, 7.0]])
        >>> centre, scale = robust_statistics(value)
        >>> centre.tolist(), [round(x, 3) for x in scale.tolist()]
        ([2.0, 7.0], [1.483, 1.0])
    """
    size, dimensions = value.shape
    rows = _spread_rows(size)
    n = size if rows is None else len(rows)
    step = max(1, 2**19 // n)
    centre, scale = (torch.zeros(dimensions, dtype=torch.float64) for _ in range(2))  # filled in place, as in _moments
    for start in range(0, dimensions, step):
        block = value[:, start : start + step]
        ordered = (block if rows is None else block[rows]).double().sort(0).values
        centre[start : start + step] = _quantile(ordered, 0.5)
        scale[start : start + step] = _first_signal(ordered)
        del ordered
    still = scale == 0
    if still.any():
        scale[still] = _deviation(value, still)
    moving = scale > 0
    if moving.any():
        moving &= scale > 1e-9 * scale[moving].median()
    return centre, scale.where(moving, 1.0)


def _first_signal(ordered: Tensor) -> Tensor:
    """Width of the first range that is a signal, of columns in ascending order; 0 where none is."""
    ends = [(_quantile(ordered, low), _quantile(ordered, high), normal) for low, high, normal in RANGES]
    widths = [(high - low) / normal for low, high, normal in ends]
    scale = torch.zeros_like(widths[0])
    for k, (low, high, _) in enumerate(ends):
        signal = widths[k] > ROUNDINGS * torch.maximum(low.abs(), high.abs())
        if k + 1 < len(ends):
            signal &= widths[k + 1] <= IDLE * widths[k]
        scale = scale.where((scale > 0) | ~signal, widths[k])
    return scale


def _spread_rows(size: int) -> Tensor | None:
    """One row of each of :data:`SAMPLE` equal stretches, at a place of its own, so that no period is met."""
    if size <= SAMPLE:
        return None
    place = torch.rand(SAMPLE, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return ((torch.arange(SAMPLE) + place) * (size / SAMPLE)).long().clamp_(max=size - 1)


def _quantile(ordered: Tensor, share: float) -> Tensor:
    """Of columns in ascending order, with linear interpolation."""
    place = share * (len(ordered) - 1)
    below = int(place)
    above = min(below + 1, len(ordered) - 1)
    return ordered[below] + (place - below) * (ordered[above] - ordered[below])


def _deviation(value: Tensor, chosen: Tensor) -> Tensor:
    """Standard deviation of the chosen dimensions; 0 where it is none but rounding."""
    parts = list(pieces(len(value), row_bytes(value)))
    columns = chosen.nonzero()[:, 0]
    first = value[:1, columns].double()
    total, most = torch.zeros(len(columns)).double(), first[0].abs()
    for part in parts:
        rows = value[part][:, columns].double()
        total += (rows - first).sum(0)
        most = torch.maximum(most, rows.abs().amax(0))
    mean = first + total / len(value)
    square = torch.zeros_like(total)
    widest = torch.zeros_like(total)
    for part in parts:
        away = value[part][:, columns].double() - mean
        square += away.square().sum(0)
        widest = torch.maximum(widest, away.abs().amax(0))
    deviation = (square / len(value)).sqrt()
    return deviation.where(widest > 8 * ROUNDINGS * most, 0.0)


class RobustScaling:
    """Vectors less their median, in multiples of their interquartile range (normalised to a standard deviation).

    Outliers move neither, and data in other units, or from another zero, becomes the same scaled data: see
    :func:`robust_statistics`, also for dimensions that do not move. Integers, images and whatever else is no vector
    ``[N, D]`` of floating-point numbers stay as they are.

    Fit it on the training split. Save :meth:`state_dict`, or :meth:`to_json`, beside the policy, and give the
    policy's actions back their unit by :meth:`unscale_action`.

    Args:
        centres: by key, each ``[D]`` float64.
        scales: by key, each ``[D]`` float64, positive.

    Raises:
        ValueError: if the keys differ, or a scale is not positive and finite.

    Examples:
        >>> from tensordict import TensorDict
        >>> newtons = TensorDict({"observation": torch.randn(100, 3), "action": torch.rand(100, 2)}, [100])
        >>> other = newtons.clone().set("action", 1000 * newtons["action"] + 3)
        >>> scaling = RobustScaling.fit(newtons)
        >>> torch.allclose(RobustScaling.fit(other)(other)["action"], scaling(newtons)["action"], atol=1e-4)
        True
        >>> torch.allclose(scaling.unscale_action(scaling(newtons)["action"]), newtons["action"], atol=1e-6)
        True
    """

    def __init__(self, centres: Mapping[NestedKey, Tensor], scales: Mapping[NestedKey, Tensor]) -> None:
        for what, given in (("centres", centres), ("scales", scales)):
            if not isinstance(given, Mapping) or not all(
                isinstance(value, Tensor) and value.is_floating_point() for value in dict(given.items()).values()
            ):
                raise TypeError(f"{what} must be a mapping, key -> tensor [D] of real numbers, got {shown(given)}")
        centres, scales = dict(centres.items()), dict(scales.items())
        if centres.keys() != scales.keys():
            raise ValueError(f"centres of {list(centres)} and scales of {list(scales)}: give both for each key")
        for key, scale in scales.items():
            if not (scale.isfinite() & (scale > 0)).all() or not centres[key].isfinite().all():
                raise ValueError(f"the scale of {key!r} must be positive and finite, and its centre finite")
            if scale.shape != centres[key].shape:
                raise ValueError(
                    f"centre {list(centres[key].shape)} and scale {list(scale.shape)} of {key!r} differ in shape"
                )
        self.centres = {key: value.double() for key, value in centres.items()}
        self.scales = {key: value.double() for key, value in scales.items()}

    @classmethod
    def fit(
        cls, demonstrations: TensorDictBase, keys: Sequence[NestedKey] = ("observation", "action")
    ) -> RobustScaling:
        """Takes the statistics from demonstrations ``[N]``, a piece at a time.

        Args:
            demonstrations: of the training split.
            keys: what is scaled; nested ones stand for what is in them.

        Raises:
            KeyError: if a key is missing.
            TypeError: if what is under it is no tensor of real numbers.
            ValueError: if there is no row, or one is NaN or infinite.
        """
        found = check_rows(demonstrations, check_keys("keys", keys))
        vectors = {key: value for key, value in found.items() if value.ndim == 2 and value.is_floating_point()}
        statistics = {key: robust_statistics(value) for key, value in vectors.items()}
        return cls(*({key: pair[k] for key, pair in statistics.items()} for k in (0, 1)))

    def __call__(self, demonstrations: TensorDictBase) -> TensorDictBase:
        """Scales what was fitted, ``[*B, D]``, and next observations where there are any; a shallow copy.

        Memory-mapped rows become memory-mapped rows in a temporary folder.
        """
        return map_rows(self._scale, demonstrations)

    def _scale(self, demonstrations: TensorDictBase) -> TensorDictBase:
        out = demonstrations.copy()
        for key in self.centres:
            for place in (key, ("next", *((key,) if isinstance(key, str) else key))):
                value = out.get(place, None)
                if value is not None:
                    out.set(place, self.scale(key, value))
        return out

    def _constants(self, key: NestedKey, value: Tensor) -> tuple[Tensor, Tensor]:
        centre, scale = self.centres[key], self.scales[key]
        if value.shape[-1:] != centre.shape:
            raise ValueError(
                f"{key!r} has shape {list(value.shape)}, the scaling was fitted to {len(centre)} dimensions: pass the "
                "entries that it was fitted to"
            )
        return centre.to(value.device), scale.to(value.device)

    def scale(self, key: NestedKey, value: Tensor) -> Tensor:
        """Scales one entry ``[*B, D]``; the dtype stays."""
        if key not in self.centres:
            return value
        centre, scale = self._constants(key, value)
        return ((value.double() - centre) / scale).to(value.dtype)

    def unscale(self, key: NestedKey, value: Tensor) -> Tensor:
        """The inverse of :meth:`scale`."""
        if key not in self.centres:
            return value
        centre, scale = self._constants(key, value)
        return (value.double() * scale + centre).to(value.dtype)

    def unscale_action(self, action: Tensor) -> Tensor:
        """Gives scaled actions ``[*B, A]`` of a policy their unit and zero again."""
        return self.unscale("action", action)

    def state_dict(self) -> dict[str, Tensor]:
        """Tensors to be saved beside a policy, by ``key.centre`` and ``key.scale``."""
        named = {key if isinstance(key, str) else ".".join(key): key for key in self.centres}
        out = {f"{name}.centre": self.centres[key] for name, key in named.items()}
        return out | {f"{name}.scale": self.scales[key] for name, key in named.items()}

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any]) -> RobustScaling:
        """What :meth:`state_dict` gave.

        Raises:
            ValueError: if a name is none of its.
        """
        parts: dict[str, dict[NestedKey, Tensor]] = {"centre": {}, "scale": {}}
        for name, value in state.items():
            *path, kind = name.split(".")
            if kind not in parts or not path:
                raise ValueError(f"{name!r} is no entry of a scaling: needed are names such as 'action.centre'")
            parts[kind][path[0] if len(path) == 1 else tuple(path)] = torch.as_tensor(value, dtype=torch.float64)
        return cls(parts["centre"], parts["scale"])

    def to_json(self) -> dict[str, list[float]]:
        """The same as lists, exact to the last digit once ``json`` has written and read them."""
        return {name: value.tolist() for name, value in self.state_dict().items()}

    @classmethod
    def from_json(cls, state: Mapping[str, Sequence[float]]) -> RobustScaling:
        """What :meth:`to_json` gave."""
        return cls.from_state_dict(state)
