"""Continuing a training from its newest checkpoint."""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from torchrl.checkpoint import Checkpoint, CheckpointError, CheckpointRotation
from torchrl.trainers import Trainer

from torchrl_tsallis._torchrl import logger as torchrl_logger
from torchrl_tsallis.jobs import disk_errors
from torchrl_tsallis.trainers.checkpoint_files import check_checkpoint, checkpoints_in, read_manifest, remove_remains
from torchrl_tsallis.trainers.logging import LoggerGroup
from torchrl_tsallis.trainers.settings import Settings, changes, check_changes, take_new
from torchrl_tsallis.trainers.start import RunStart

_BROKEN = (OSError, ValueError, KeyError, RuntimeError, zipfile.BadZipFile, json.JSONDecodeError)
_VERSION = 1  # of TorchRL's checkpoints and of its adapters, that this package reads


class SafeRotation(CheckpointRotation):
    """TorchRL's folder of the newest checkpoints, whose errors name what cannot be written."""

    def save(self, *args: Any, **kwargs: Any) -> Path:
        """See ``CheckpointRotation.save``; on a full disk nothing but the checkpoints of before is left.

        Raises:
            OSError: if the folder cannot be written; the message names it.
        """
        with disk_errors(self.directory):
            return super().save(*args, **kwargs)


def _reason(error: BaseException) -> str:
    """The component and the innermost error; the chain between them repeats whole tensordicts."""
    component = re.findall(r"component '(\w+)'", str(error))[:1]
    while error.__cause__ or error.__context__:
        error = error.__cause__ or error.__context__  # type: ignore[assignment]
    return ", ".join([*component, str(error).split("\n", 1)[0]])


def _check_version(manifest: Mapping[str, Any], path: Path) -> None:
    """Refuses a checkpoint of a newer format."""
    components = manifest.get("components")
    records = list(components.values()) if isinstance(components, dict) else []
    versions = [manifest.get("format_version"), *(r.get("adapter_version") for r in records if isinstance(r, dict))]
    newer = [version for version in versions if isinstance(version, int) and version > _VERSION]
    if newer:
        raise RuntimeError(
            f"{str(path)!r} is of the newer format {max(newer)}, this version reads {_VERSION}: update torchrl and "
            "torchrl_tsallis to those that wrote it, or choose another output folder"
        )


def _read(path: Path) -> dict[str, Any]:
    """The description of a checkpoint whose files are safe to load."""
    try:
        manifest = read_manifest(path)
        _check_version(manifest, path)
        check_checkpoint(path)
    except PermissionError as error:
        raise RuntimeError(f"{str(path)!r} cannot be read ({error.strerror}): check its permissions") from error
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise RuntimeError(
            f"{str(path)!r} is truncated or no checkpoint ({error}): delete it to continue from the one before, or to "
            "start anew if it is the only one"
        ) from error
    return manifest


def _load(trainer: Trainer, path: Path, components: set[str]) -> None:
    """Loads components of a checkpoint whose files were looked at."""
    assert trainer.checkpoint is not None
    try:
        Checkpoint.manifest(path)
        trainer.checkpoint.load(path, components=components, map_location="cpu")
    except CheckpointError as error:
        raise RuntimeError(
            f"{str(path)!r} does not fit this run ({_reason(error)}): resume with the settings and data that it was "
            "made with, or choose another output folder"
        ) from error
    except _BROKEN as error:
        raise RuntimeError(
            f"{str(path)!r} is truncated or damaged ({error}): delete it to continue from the one before"
        ) from error


def resume(trainer: Trainer, settings: Settings = "refuse") -> int:
    """Loads the newest checkpoint of a trainer's folder, bit for bit; call it before ``train()``.

    What is around the trainer is restored as well: log rows later than the checkpoint are cut, a training that was
    stopped early stays stopped, and what killed processes left in the folder is removed. No code in a checkpoint is
    run: its files are looked at first, see the page about security.

    Args:
        trainer: made by :func:`~torchrl_tsallis.trainers.make_offline_trainer` with a ``checkpoint_dir``, from the same
            settings and data as the run that is continued. More steps are no other settings.
        settings: what is done where settings differ from the checkpoint's: ``"refuse"`` raises; ``"checkpoint"`` keeps
            the checkpoint's learning rate, options of the optimizer and schedule; ``"new"`` takes those of the trainer.
            A schedule is then replayed up to the step that it had reached. Default: ``"refuse"``.

    Returns:
        The number of steps that are done already; 0 if there is no checkpoint. ``train()`` does nothing for a run that
        is finished or was stopped.

    Raises:
        ValueError: if the trainer has no checkpoint folder, or settings changed and none may be taken.
        UnsafeCheckpointError: if the checkpoint holds what could run code; nothing of it is loaded.
        RuntimeError: if the checkpoint is truncated, of a newer format, or of another network, optimizer or data set;
            the message names the file, the component and the fix.
    """
    rotation = trainer.checkpoint_rotation
    if rotation is None:
        raise ValueError("the trainer keeps no checkpoints: give make_offline_trainer a checkpoint_dir")
    if settings not in get_args(Settings):
        raise ValueError(f"no settings {settings!r}: choose {', '.join(get_args(Settings))}")
    start = getattr(trainer.checkpoint_metadata, "__self__", None)
    if not isinstance(start, RunStart):
        raise ValueError("the trainer was not made by make_offline_trainer: load its checkpoints by load_from_file")
    remove_remains(rotation.directory, rotation.prefix)
    found = checkpoints_in(rotation.directory, rotation.prefix)
    changed: dict[str, tuple[Any, Any]] = {}
    if found:
        path = found[-1][1]
        manifest = _read(path)
        components = set(trainer.checkpoint.components) - {"logger"}  # type: ignore[union-attr]
        before = (manifest.get("metadata") or {}).get("settings")
        if before is None:
            torchrl_logger.warning("%s does not say by which settings it was made: they are not compared", path)
        else:
            changed = changes(before, start.settings)
            check_changes(changed, settings, str(path))
        if settings == "new":
            components &= set(manifest["components"])
        _load(trainer, path, components)
        if settings == "new":
            take_new(trainer, changed)
        else:
            start.settings = {**start.settings, **{name: old for name, (old, _) in changed.items()}}
        if trainer.collected_frames % trainer.optim_steps_per_batch:
            raise ValueError(
                f"{str(path)!r} is of step {trainer.collected_frames}, which is no multiple of the new "
                f"log_every={trainer.optim_steps_per_batch}: choose one that divides it"
            )
    start.resumed = True
    if isinstance(trainer.logger, LoggerGroup):
        trainer.logger.cut(int(trainer.collected_frames))
    return int(trainer.collected_frames)
