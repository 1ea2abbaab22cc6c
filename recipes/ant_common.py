"""What recipes/ant_noise.py and recipes/ant_figure3.py share."""

from __future__ import annotations

from typing import Any

from collect_ant import collect_dataset
from common import as_list
from omegaconf import DictConfig

from torchrl_tsallis.data import TASKS

#: The entries of the configuration that decide about a policy.
TRAINING = ("policy", "loss", "tuner", "optimizer", "updater", "epochs", "batch_size", "data")


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
