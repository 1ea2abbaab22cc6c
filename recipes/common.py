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
from torchrl_tsallis.runs.saved import save_run
from torchrl_tsallis.runs.source import identity


def as_list(value: Any) -> list[Any]:
    """One value or a list of them, as a list."""
    return list(value) if isinstance(value, (list, ListConfig)) else [value]


def make_rating(cfg: DictConfig, method: DictConfig | Sequence[DictConfig]) -> tuple[Any, Any]:
    """The rating of a method, and what tunes it.

    Args:
        cfg: of the recipe; ``ratings`` and ``tuners`` hold the kinds that methods are settings of.
        method: ``rating``, the kind; ``tuned``; and the rating's own settings. Of stacked members a sequence of methods
            of one kind.

    Returns:
        The rating, and its tuner as a partial that waits for the loss; None where nothing is tuned.

    Raises:
        ValueError: if the methods are of several kinds.
    """
    stacked = not isinstance(method, DictConfig)
    settings = [dict(one) for one in (method if stacked else [method])]
    kinds = {one.pop("rating") for one in settings}
    if len(kinds) > 1:
        raise ValueError(f"methods of the kinds {sorted(kinds)} cannot be trained as one program")
    kind, tuned = kinds.pop(), [bool(one.pop("tuned")) for one in settings]
    values = {name: [one[name] for one in settings] if stacked else settings[0][name] for name in settings[0]}
    tuner = instantiate(cfg.tuners[kind]) if any(tuned) else None
    if tuner is not None and stacked:
        tuner = partial(tuner, tuned=tuned)
    return instantiate(cfg.ratings[kind], **values), tuner


def make_trainer(
    cfg: DictConfig,
    loss: Any,
    buffer: Any,
    *,
    epoch: int,
    tuner: Any,
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
        tuner: of its rating, as :func:`make_rating` gives it.
        logger: its loggers.
        folder: its checkpoints are in a folder there.
        optimizer: further arguments of the optimizer.

    Returns:
        The trainer, which has not begun.
    """
    return instantiate(cfg.trainer, _partial_=True)(
        loss=loss,
        replay_buffer=buffer,
        optimizer=instantiate(cfg.optimizer, **optimizer),
        updater=instantiate(cfg.updater),
        tuner=tuner,
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
    return before != wanted and not (before != before and wanted != wanted)  # NaN is as it was


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


def save_as_run(
    folder: Path, cfg: DictConfig, loss: Any, actor: Any, data: Any, *, about: dict[str, Any], seed: int, command: str
) -> None:
    """Leaves a training as a folder that ``torchrl_tsallis.run.Run`` opens; the policy is last, and marks it as done.

    Args:
        folder: of the training.
        cfg: of the recipe.
        loss: trained, of one policy.
        actor: the policy, of ``make_policy``.
        data: that it was trained on, ``[N]``.
        about: what else to say of the data.
        seed: of the training.
        command: that made it.
    """
    sizes = {"obs_dim": data["observation"].shape[1], "action_dim": data["action"].shape[1]}
    keys = {"observation": ["observation"], "action": ["action"]}
    target = loss.target_actor_network_params.data.flatten_keys(".") if loss.needs_target else None
    save_run(
        folder,
        kind="recipe",
        actor=actor.state_dict(),
        rating=loss.rating_module.state_dict(),
        rating_class=type(loss.rating_module),
        arguments={**sizes, "hidden": list(cfg.policy.hidden)},
        data={"path": "", "format": "memory", "keys": keys, "identity": identity(data), "steps": len(data), **about},
        train={"epochs": cfg.epochs, "batch_size": cfg.batch_size, "seed": seed, "lr": cfg.optimizer.lr},
        command=command,
        target=None if target is None else dict(target.items()),
    )
