"""Units of what the network sees: by mean and one chosen unit, or by robust statistics that need no unit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_tsallis._checks import check_number, shown
from torchrl_tsallis.data.rows import PIECE, map_rows, pieces, row_bytes
from torchrl_tsallis.data.schema import bad_rows, leaves

#: A spread below so many float32 roundings of the values themselves is no signal.
ROUNDINGS = 64 * torch.finfo(torch.float32).eps


@dataclass(frozen=True)
class Scaling:
    """Standardised observations, and actions in multiples of one chosen unit.

    The density of the action has the unit of the action, and with it q and gamma: ``action_unit`` decides in which
    regime the method works. One unit for all directions keeps the geometry of a force. Where no unit is known,
    :class:`~torchrl_tsallis.data.RobustScaling` needs none.

    Args:
        mean: of the observation, ``[O]``.
        std: of the observation, ``[O]``, positive.
        action_unit: the action's unit, e.g. in N.

    Raises:
        TypeError: for a mean or deviation that is no vector.
        ValueError: if one is not finite, or a deviation or the unit not positive.

    Examples:
        >>> from tensordict import TensorDict
        >>> data = TensorDict({"observation": torch.tensor([[1.0], [3.0]]), "action": torch.ones(2, 1)}, [2])
        >>> Scaling.fit(data, action_unit=0.5)(data)["observation"][:, 0]
        tensor([-1.,  1.])
    """

    mean: Tensor
    std: Tensor
    action_unit: float

    def __post_init__(self) -> None:
        """Raises for what no data can be divided by."""
        for name in ("mean", "std"):
            value = getattr(self, name)
            if not isinstance(value, Tensor) or not value.is_floating_point() or value.ndim != 1:
                raise TypeError(f"{name} must be a tensor [O] of real numbers, got {shown(value)}")
            if not value.isfinite().all() or value.shape != self.mean.shape:
                raise ValueError(f"{name} must be finite, and std of the shape of mean, got {shown(value)}")
        if not (self.std > 0).all():
            raise ValueError(f"std must be positive, got {shown(self.std)}")
        check_number("action_unit", self.action_unit, above=0)

    @classmethod
    def fit(cls, demonstrations: TensorDictBase, *, action_unit: float) -> Scaling:
        """Takes mean and (biased) deviation from demonstrations ``[N]``; what is constant is only centred.

        Constant is also what deviates by less than 64 roundings of float32.

        Raises:
            KeyError: if there is no observation.
            TypeError: if the observation is a nested tensordict.
            ValueError: if the unit is not positive and finite, or the observation is no vector.
        """
        action_unit = check_number("action_unit", action_unit, above=0)
        if not isinstance(demonstrations, TensorDictBase) or not demonstrations.ndim or 0 in demonstrations.shape:
            raise ValueError(f"demonstrations must be a TensorDict of at least one row, got {shown(demonstrations)}")
        found = leaves(demonstrations, ["observation"])
        if list(found) != ["observation"]:
            raise TypeError(f"'observation' is nested, {list(found)}: use RobustScaling, or concatenate the vectors")
        observation = found["observation"]
        if observation.ndim <= demonstrations.ndim:
            raise ValueError(f"'observation' has shape {list(observation.shape)}, needed is a vector a row: [N, O]")
        if bad_rows(observation.flatten(0, -2))[0]:
            raise ValueError("'observation' is NaN or infinite in some rows: validate_demonstrations names them")
        mean, std = _moments(observation.flatten(0, -2))
        floor = torch.maximum(1e-9 * (1 + mean.abs()), ROUNDINGS * mean.abs())
        return cls(mean.float(), std.where(std > floor, 1.0).float(), float(action_unit))

    def __call__(self, demonstrations: TensorDictBase) -> TensorDictBase:
        """Scales observations ``[*B, O]``, next ones where there are any, and actions ``[*B, A]``; a shallow copy.

        Memory-mapped rows become memory-mapped rows in a temporary folder.
        """
        return map_rows(self._scale, demonstrations)

    def _scale(self, demonstrations: TensorDictBase) -> TensorDictBase:
        out = demonstrations.copy()
        for key in ("observation", ("next", "observation")):
            value = out.get(key, None)
            if value is not None:
                out.set(key, (value - self.mean) / self.std)
        return out.set("action", out["action"] / self.action_unit)

    def unscale_action(self, action: Tensor) -> Tensor:
        """Gives scaled actions ``[*B, A]`` their unit again."""
        return action * self.action_unit

    def state_dict(self) -> dict[str, Tensor]:
        """Tensors to be saved beside a policy."""
        unit = torch.tensor([self.action_unit])
        return {"observation_mean": self.mean, "observation_std": self.std, "action_unit": unit}

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any]) -> Scaling:
        """What :meth:`state_dict` gave."""
        return cls(state["observation_mean"], state["observation_std"], float(state["action_unit"]))


def _moments(value: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and (biased) deviation of ``[N, D]`` in float64, each ``[D]``."""
    if row_bytes(value) * len(value) <= 4 * PIECE:
        std, mean = torch.std_mean(value.double(), 0, correction=0)
        return mean, std
    # Sums in place: small results that live between the pieces would keep the freed ones from being used again.
    parts = list(pieces(len(value), row_bytes(value)))
    mean, square = (torch.zeros(value.shape[1], dtype=torch.float64) for _ in range(2))
    for part in parts:
        mean += value[part].double().sum(0)
    mean /= len(value)
    for part in parts:
        square += value[part].double().sub_(mean).square_().sum(0)
    return mean, square.div_(len(value)).sqrt_()
