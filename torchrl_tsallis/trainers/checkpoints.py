"""Continuing a training from its newest checkpoint."""

from __future__ import annotations

import json
import re
import zipfile
from pathlib import Path

from torchrl.checkpoint import CheckpointError
from torchrl.trainers import Trainer

_BROKEN = (OSError, ValueError, KeyError, RuntimeError, zipfile.BadZipFile, json.JSONDecodeError)


def _reason(error: BaseException) -> str:
    """The component and the innermost error; the chain between them repeats whole tensordicts."""
    component = re.findall(r"component '(\w+)'", str(error))[:1]
    while error.__cause__ or error.__context__:
        error = error.__cause__ or error.__context__  # type: ignore[assignment]
    return ", ".join([*component, str(error).split("\n", 1)[0]])


def resume(trainer: Trainer) -> int:
    """Loads the newest checkpoint of a trainer's folder, bit for bit; call it before ``train()``.

    Args:
        trainer: made by :func:`~torchrl_tsallis.trainers.make_offline_trainer` with a ``checkpoint_dir``, from the same
            settings and data as the run that is continued.

    Returns:
        The number of steps that are done already; 0 if there is no checkpoint. A finished run must not be trained
        again: compare with ``trainer.total_frames``.

    Raises:
        ValueError: if the trainer has no checkpoint folder.
        RuntimeError: if the checkpoint is truncated or of another network, optimizer or data set; the message names the
            file, the component and the fix.
    """
    rotation = trainer.checkpoint_rotation
    if rotation is None:
        raise ValueError("the trainer keeps no checkpoints: give make_offline_trainer a checkpoint_dir")
    # The rotation itself passes over files that it cannot read; here that would silently start anew.
    found = sorted(Path(rotation.directory).glob(f"{rotation.prefix}*"), key=lambda path: path.name)
    if not found:
        return 0
    path = rotation.latest()
    if path is None or path.name < found[-1].name:
        raise RuntimeError(
            f"{str(found[-1])!r} is truncated or no checkpoint: delete it to continue from the one before, or to start "
            "anew if it is the only one"
        )
    try:
        trainer.load_from_file(path)
    except CheckpointError as error:
        raise RuntimeError(
            f"{str(path)!r} does not fit this run ({_reason(error)}): resume with the settings and data that it was "
            "made with, or choose another output folder"
        ) from error
    except _BROKEN as error:
        raise RuntimeError(
            f"{str(path)!r} is truncated or damaged ({error}): delete it to continue from the one before"
        ) from error
    return int(trainer.collected_frames)
