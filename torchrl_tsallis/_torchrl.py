"""Every private name of TorchRL and tensordict that this package uses, each with its reason.

They are those of TorchRL 0.14 and tensordict 0.14. ``tests/test_torchrl.py`` fails when one of them changes its place
or its meaning, so that a new version is met here and nowhere else.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl._utils import logger as logger  # warnings belong where TorchRL's own go, whose level a user sets there
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.objectives.common import LossModule
from torchrl.objectives.utils import TargetNetUpdater
from torchrl.trainers import Trainer

#: How tensordict names its class of tensors alone in the files of a folder. It loads a folder by the class that is
#: named there, and unpickles what belongs to another one.
PLAIN_CLASS = "<class 'tensordict._td.TensorDict'>"


def own_log_times(trainer: Trainer) -> None:
    """Gives a trainer its own times of logging: TorchRL shares them between all, and a second trainer is silent."""
    trainer._last_log = {}


def optim_steps(trainer: Trainer) -> int:
    """Steps of the optimizer so far, which no public attribute tells."""
    return int(trainer._optim_count)


def registered_modules(trainer: Trainer) -> dict[str, Any]:
    """What is registered for checkpoints, by name; TorchRL has no reader for it."""
    return dict(trainer._modules)


def advance_bar(trainer: Trainer) -> None:
    """Starts the progress bar where the checkpoint was; TorchRL starts it at 0."""
    if trainer.progress_bar:
        trainer._pbar.update(trainer.collected_frames)


def stop_reason(trainer: Trainer) -> str | None:
    """Why a stop was requested; None if it was not. TorchRL does not keep it in checkpoints."""
    return (trainer._stop_reason or "stop requested") if trainer._stop_training else None


def withdraw_stop(trainer: Trainer) -> None:
    """Takes a requested stop back, for which there is no public method."""
    trainer._stop_training, trainer._stop_reason = False, None


def sampler_rng(sampler: Sampler) -> torch.Generator | None:
    """The generator of a sampler; ``set_rng`` is public, a reader is not."""
    return sampler._rng


def reduce_loss(loss: LossModule, value: torch.Tensor, tensordict: TensorDictBase, **options: Any) -> torch.Tensor:
    """Reduces by ``loss.reduction`` over the valid samples alone; TorchRL's losses share it, but do not export it."""
    return loss._reduce_loss(value, tensordict, **options)


def loss_mask_keys(loss: LossModule) -> Any:
    """Where a loss looks for the mask of valid samples; it is what ``loss_mask_key="auto"`` means."""
    return loss._loss_mask_keys()


def expand_loss_mask(loss: LossModule, mask: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    """A mask with the shape of a loss's values, as TorchRL's own reduction makes it."""
    return loss._expand_loss_mask(mask, like)


def clear_weakrefs(loss: LossModule, *names: Any) -> None:
    """Drops references that would keep ``torch.compile`` from tracing the loss a second time."""
    loss._clear_weakrefs(*names)


def parts_of(actor: TensorDictModuleBase) -> list[TensorDictModuleBase]:
    """The modules of a probabilistic actor in their order, its distribution last; TorchRL's indexing nests them."""
    return list(actor._module_iter())


def source_and_target_params(updater: TargetNetUpdater) -> tuple[TensorDictBase, TensorDictBase]:
    """Parameters that are followed, and those that follow; an updater with a state a tensor needs both."""
    return updater._sources, updater._targets
