"""What the recipes on the Ant share: its data."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from collect_ant import collect_dataset
from common import as_list
from omegaconf import DictConfig

from torchrl_tsallis.data import TASKS, make_task, replace_pairs

#: The entries of the configuration that decide about a policy.
TRAINING = ("policy", "ratings", "tuners", "optimizer", "updater", "epochs", "batch_size", "data")
#: Share of the pairs that others replace in the tasks named so.
CONFLICTS = {"conflict_20": 0.2, "conflict_40": 0.4}


def check_names(cfg: DictConfig, asked: DictConfig | None = None) -> None:
    """Refuses tasks and methods that do not exist; those of ``asked``, or of the configuration itself."""
    for name, allowed in (("task", (*TASKS, *CONFLICTS)), ("method", cfg.methods)):
        unknown = [value for value in as_list((asked or cfg)[name]) if value not in allowed]
        if unknown:
            raise SystemExit(f"no {name} {unknown[0]!r}: choose one or a list of {', '.join(allowed)}")


def demonstrations(cfg: DictConfig, progress: bool = False) -> tuple[Any, Any]:
    """The recorded demonstrations of the experts and the amateur, from the cache or made now."""
    return _recorded(cfg, tuple(cfg.data.policies[:-1]), progress)


def _recorded(cfg: DictConfig, experts: tuple[str, ...], progress: bool) -> tuple[Any, Any]:
    data = cfg.data
    return collect_dataset(
        data.cache,
        std=data.std,
        seed=data.seed,
        length=data.length,
        clip=data.clip,
        experts=experts,
        amateur=data.policies[-1],
        workers=cfg.workers,
        progress=progress,
    )


def ratings_file(cfg: DictConfig, task: str, std: float, seed: int) -> Path:
    """Where recipes/curation.py leaves what it knows of a task's demonstrations."""
    return Path(cfg.output).absolute() / "ratings" / f"std_{std:g}" / task / f"seed_{seed}.npz"


def task_data(task: str, cfg: DictConfig, seed: int) -> Any:
    """The demonstrations of a task, ``[N]``: one of the paper's four, or a conflict with learners pair by pair.

    ``both@surprise`` is the task ``both`` without the episodes of largest surprise, ``both@return`` without those of
    least return; recipes/curation.py has written both down.
    """
    task, _, rule = task.partition("@")
    experts, amateur = demonstrations(cfg)
    if task in CONFLICTS:
        others, _ = _recorded(cfg, tuple(cfg.data.learners), False)
        return replace_pairs(experts, others, share=CONFLICTS[task], seed=seed)
    data = make_task(task, experts, amateur, seed=seed, **cfg.data.noise)
    if not rule:
        return data
    known = np.load(ratings_file(cfg, task, cfg.data.std, seed))
    worst_first = np.argsort(-known["surprise"] if rule == "surprise" else known["ep_return"], kind="stable")
    dropped = worst_first[: int(cfg.curated.share * len(worst_first))]
    number = np.arange(len(data)) // cfg.data.length
    return data[torch.from_numpy(~np.isin(number, dropped))]
