"""What the recipes that train share."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig, ListConfig, OmegaConf
from torchrl.trainers import Trainer

from torchrl_tsallis.jobs import atomic_path


def as_list(value: Any) -> list[Any]:
    """One value or a list of them, as a list."""
    return list(value) if isinstance(value, (list, ListConfig)) else [value]


def make_trainer(
    cfg: DictConfig,
    loss: Any,
    buffer: Any,
    *,
    epoch: int,
    tuned: Any,
    logger: Any,
    folder: Path,
    **optimizer: Any,
) -> Trainer:
    """Assembles a training from the configuration.

    Args:
        cfg: of the recipe.
        loss: its loss.
        buffer: replay buffer of its data.
        epoch: steps an epoch, after which it logs.
        tuned: whether q is tuned; of stacked members a list.
        logger: its loggers.
        folder: its checkpoints are in a folder there.
        optimizer: further arguments of the optimizer.

    Returns:
        The trainer, which has not begun.
    """
    tuner = instantiate(cfg.tuner)
    if isinstance(tuned, list):
        tuner, tuned = partial(tuner, tuned=tuned), any(tuned)
    return instantiate(cfg.trainer, _partial_=True)(
        loss=loss,
        replay_buffer=buffer,
        optimizer=instantiate(cfg.optimizer, **optimizer),
        updater=instantiate(cfg.updater),
        tuner=tuner if tuned else None,
        logger=logger,
        steps=cfg.epochs * epoch,
        log_every=epoch,
        checkpoint_dir=folder / "checkpoints",
        checkpoint_every=cfg.checkpoint_every * epoch,
        progress=False,  # the main process shows one bar for all of them
    )


def differ(before: Any, wanted: Any) -> bool:
    """Whether settings differ; an option that one of the two versions of the package does not have does not count."""
    if isinstance(before, dict) and isinstance(wanted, dict):
        return any(differ(before[name], wanted[name]) for name in before.keys() & wanted.keys())
    return before != wanted


def keep_settings(file: Path, settings: Mapping[str, Any], names: Sequence[str], way_out: str = "") -> None:
    """Writes settings to a file, which must not hold other ones already.

    Args:
        file: JSON file, in a folder of results.
        settings: by name.
        names: of those that are kept.
        way_out: what else can be done than to choose another output, if anything.

    Raises:
        SystemExit: if they changed; the message names which.
    """
    wanted = json.loads(json.dumps({name: settings[name] for name in names}))
    before = json.loads(file.read_text()) if file.exists() else wanted
    changed = [name for name in wanted if differ(before.get(name), wanted[name])]
    if changed:
        advice = f"choose another output{', or ' * bool(way_out)}{way_out}"
        raise SystemExit(f"{file} was made with other {', '.join(changed)}: {advice}")
    with atomic_path(file) as path:
        path.write_text(json.dumps(wanted, indent=1))


def keep_method_settings(cfg: DictConfig, folders: Mapping[Path, str], names: Sequence[str]) -> None:
    """Keeps the settings of trainings in their folders; a resumed one must have the same.

    Args:
        cfg: of the recipe.
        folders: of the trainings, with the method of each.
        names: of the settings that are kept along with the method's own.

    Raises:
        SystemExit: as :func:`keep_settings`.
    """
    every = OmegaConf.to_container(cfg, resolve=True)
    for folder, name in folders.items():
        method = every["methods"][name]
        keep_settings(folder / "settings.json", every | method, (*names, *method), "resume=false")
