"""What a loss that wraps another one takes over from it."""

from __future__ import annotations

from typing import Any

from tensordict.utils import NestedKey
from torch import nn
from torchrl.objectives.common import LossModule

from torchrl_tsallis.objectives.inputs import check_key


class WrappedLoss:
    """Mixin of :class:`~torchrl_tsallis.RatedLoss`: keys, mask, parameters and modes are the wrapped loss's."""

    loss_module: LossModule

    @property
    def tensor_keys(self) -> Any:
        """The wrapped loss's."""
        return self.loss_module.tensor_keys

    @property
    def in_keys(self) -> list[NestedKey]:
        """The wrapped loss's."""
        return self.loss_module.in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self.loss_module.in_keys = values

    @property
    def _loss_mask_key(self) -> NestedKey | None:
        return self.loss_module._loss_mask_key

    @_loss_mask_key.setter
    def _loss_mask_key(self, value: NestedKey | None) -> None:
        self.loss_module._loss_mask_key = value

    def set_keys(self, **kwargs: NestedKey | None) -> None:
        """Sets the wrapped loss's keys."""
        for name, key in kwargs.items():
            check_key(name, key)
        self.loss_module.set_keys(**kwargs)

    def reset_parameters_recursive(self) -> None:
        """Resets the wrapped loss's parameters."""
        self.loss_module.reset_parameters_recursive()

    def _make_vmap(self) -> None:
        """There is none."""

    @property
    def _networks_asked(self) -> list[nn.Module]:
        return [part for part in self.loss_module.__dict__.values() if isinstance(part, nn.Module)]
