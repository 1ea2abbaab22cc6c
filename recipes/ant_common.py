"""What recipes/ant_noise.py and recipes/ant_figure3.py share."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from collect_ant import collect_dataset
from omegaconf import DictConfig, ListConfig

from torchrl_tsallis._io import atomic_path
from torchrl_tsallis.data import TASKS

#: The entries of the configuration that decide about a policy.
TRAINING = ("policy", "loss", "tuner", "optimizer", "updater", "epochs", "batch_size", "data")


def as_list(value: Any) -> list[Any]:
    """One value or a list of them, as a list."""
    return list(value) if isinstance(value, (list, ListConfig)) else [value]


def check_names(cfg: DictConfig) -> None:
    """Refuses tasks and methods that do not exist."""
    for name, allowed in (("task", TASKS), ("method", cfg.methods)):
        unknown = [value for value in as_list(cfg[name]) if value not in allowed]
        if unknown:
            raise SystemExit(f"no {name} {unknown[0]!r}: choose one or a list of {', '.join(allowed)}")


def demonstrations(cfg: DictConfig, progress: bool = False) -> tuple[Any, Any]:
    """The recorded demonstrations, from the cache or made now."""
    data = cfg.data
    return collect_dataset(
        data.cache,
        std=data.std,
        seed=data.seed,
        length=data.length,
        clip=data.clip,
        experts=tuple(data.policies[:-1]),
        amateur=data.policies[-1],
        workers=cfg.workers,
        progress=progress,
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
