"""The beginning of a training: at zero in an empty folder, or where a checkpoint was."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.checkpoint import CheckpointRotation
from torchrl.trainers import Trainer

from torchrl_tsallis._checks import check_number
from torchrl_tsallis._torchrl import advance_bar, stop_reason, withdraw_stop
from torchrl_tsallis.jobs import check_writable
from torchrl_tsallis.trainers.checkpoint_files import checkpoints_in, remove, remove_remains
from torchrl_tsallis.trainers.logging import LoggerGroup
from torchrl_tsallis.trainers.settings import settings_of


class OfflineClock:
    """Stands where a trainer expects its collector; delivers ``steps`` empty frames at a time.

    It ends where the training does, so that one which has reached its last step, or was stopped, is not trained on.

    Args:
        steps: gradient steps between two points of logging.

    Examples:
        >>> next(iter(OfflineClock(117))).numel()
        117
    """

    init_random_frames = 0

    def __init__(self, steps: int) -> None:
        self.steps = int(check_number("steps", steps, low=1, integer=True))
        self._trainer: Trainer | None = None
        self._stopped: str | None = None

    def follow(self, trainer: Trainer) -> None:
        """Ends with the training of this trainer."""
        self._trainer = trainer

    @property
    def stopped(self) -> str | None:
        """Why the training was stopped before its last step; None if it was not."""
        requested = None if self._trainer is None else stop_reason(self._trainer)
        return requested or self._stopped

    def go_on(self) -> None:
        """Lets a stopped training go on."""
        self._stopped = None
        if self._trainer is not None:
            withdraw_stop(self._trainer)

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Delivers frames until the training is at its end."""
        while self._trainer is None or (
            self.stopped is None and self._trainer.collected_frames < self._trainer.total_frames
        ):
            yield TensorDict({}, [self.steps])

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Seeds torch, as a collector's environments would be."""
        torch.manual_seed(seed)
        return seed

    def update_policy_weights_(self, *args: Any, **kwargs: Any) -> None:
        """There is no policy to update."""

    def shutdown(self, *args: Any, **kwargs: Any) -> None:
        """There is nothing to shut down."""

    def state_dict(self) -> dict[str, Any]:
        """Why the training was stopped, if it was."""
        return {"stopped": self.stopped}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores the state."""
        self._stopped = state_dict.get("stopped")


class RunStart:
    """The hook with which a training begins: it refuses a used folder, and keeps the settings for checkpoints.

    Args:
        trainer: that begins.
        overwrite: whether checkpoints and later log rows of another run are removed.
    """

    def __init__(self, trainer: Trainer, overwrite: bool = False) -> None:
        self.trainer = trainer
        self.overwrite = overwrite
        self.resumed = False
        self._settings: dict[str, Any] | None = None

    @property
    def settings(self) -> dict[str, Any]:
        """What the training was made with, as it was when it began or was resumed."""
        if self._settings is None:
            self._settings = settings_of(self.trainer)
        return self._settings

    @settings.setter
    def settings(self, settings: dict[str, Any]) -> None:
        self._settings = settings

    def metadata(self, _: Trainer) -> dict[str, Any]:
        """What a checkpoint's description holds beside TorchRL's."""
        return {"settings": self.settings}

    def __call__(self) -> None:
        """Called when the training begins."""
        _ = self.settings
        rotation = self.trainer.checkpoint_rotation
        if rotation is not None:
            check_writable(rotation.directory)  # before hours of training
        if self.trainer.collected_frames == 0 and not self.resumed:
            self._begin_anew(rotation, self.trainer.logger)
        advance_bar(self.trainer)

    def _begin_anew(self, rotation: CheckpointRotation | None, logger: Any) -> None:
        """Refuses or clears what another run has left.

        Raises:
            FileExistsError: if there is something, and it may not be overwritten.
        """
        found = []
        if rotation is not None:
            remove_remains(rotation.directory, rotation.prefix)
            found = checkpoints_in(rotation.directory, rotation.prefix)
        last = logger.last_step() if isinstance(logger, LoggerGroup) else None
        used = [f"{str(found[0][1].parent)!r} holds checkpoints up to step {found[-1][0]}"] if found else []
        used += [f"the logs of {logger} have rows up to step {last}"] if last else []
        if used and not self.overwrite:
            raise FileExistsError(
                f"{' and '.join(used)} of an earlier run: call resume(trainer) first to go on with it, give "
                "make_offline_trainer overwrite=True to begin anew, or choose another folder"
            )
        for _, path in found:
            remove(path)
        if last:
            logger.cut(0)
