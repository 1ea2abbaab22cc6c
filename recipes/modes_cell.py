"""The work of recipes/ant_modes.py on one cell: its modes, and what a policy of each is worth."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from ant_common import task_data
from ant_sweep import of_condition
from ant_units import Key
from omegaconf import DictConfig
from torchrl import torchrl_logger

from torchrl_tsallis.data import find_episodes
from torchrl_tsallis.data.rows import take_rows
from torchrl_tsallis.envs import make_ant
from torchrl_tsallis.evaluation import evaluate_policies
from torchrl_tsallis.jobs import atomic_path, tick
from torchrl_tsallis.modes import find_modes_of_each
from torchrl_tsallis.runs.members import Split, train_members
from torchrl_tsallis.runs.policies import ScaledMeanPolicy
from torchrl_tsallis.trainers import keep_freed_memory


def labels_of(data: Any, amateur: int) -> torch.Tensor:
    """Who demonstrated each row."""
    info, names = data["info"], set(data["info"].keys())
    expert = info["expert"].reshape(len(data))
    by_amateur = info["is_amateur"].reshape(len(data)) if "is_amateur" in names else expert < 0
    return expert.where(~by_amateur, torch.full_like(expert, amateur))


def quiet() -> None:
    """For a process of a pool."""
    torchrl_logger.setLevel("ERROR")
    keep_freed_memory()


def write(path: Path, answer: dict[str, Any]) -> None:
    """Writes a file of a cell, all at once."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(answer))


def search(keys: tuple[Key, ...], cfg: DictConfig) -> None:
    """Finds the modes of some seeds of a cell, in a process of its own."""
    quiet()
    keys = tuple(key for key in keys if not file_of(key, "found", cfg).exists())
    sets = [data_of(key, cfg) for key in keys]
    options = {"updates": cfg.updates, "batch_size": cfg.batch_size, "device": cfg.device}
    each = find_modes_of_each(sets, seeds=[key.seed for key in keys], **cfg.search, **options) if keys else []
    for key, found, rows in zip(keys, each, sets, strict=True):
        modes = found.of_episodes
        answer = {"agreement": found.agreement, "recommended": found.recommended, "mode": modes.tolist()}
        answer["membership"] = found.membership[modes, torch.arange(len(modes))].tolist()
        answer["expert"] = rows["expert"][find_episodes(rows).starts].tolist()
        write(file_of(key, "found", cfg), answer)
    tick()


def evaluate(key: Key, cfg: DictConfig) -> None:
    """Trains a policy of each mode that was found, and lets it walk, in a process of its own."""
    quiet()
    file = file_of(key, "returns", cfg)
    if not file.exists():
        found = json.loads(file_of(key, "found", cfg).read_text())
        rows, modes = data_of(key, cfg), torch.tensor(found["mode"])
        numbers, counts = modes.unique(return_counts=True)
        large = [int(k) for k, n in zip(numbers, counts, strict=True) if n >= cfg.smallest or k == found["recommended"]]
        write(file, {str(k): evaluated(rows, modes[rows["episode"]] != k, key.seed, cfg) for k in large})
    tick()


def data_of(key: Key, cfg: DictConfig) -> Any:
    """A cell's demonstrations, with the episode and the demonstrator of each row; the amateur is the last one."""
    data = task_data(key.task, of_condition(cfg, key), key.seed)
    rows = data.select("observation", "action").set("episode", torch.arange(len(data)) // cfg.data.length)
    return rows.set("expert", labels_of(data, len(cfg.trios[key.trio]) - 1))


def evaluated(rows: Any, left_out: torch.Tensor, seed: int, cfg: DictConfig) -> list[float]:
    """Returns of the policy that is trained on the other rows, for as many passes over them as those of a recipe."""
    kept = take_rows(rows, ~left_out)
    steps = cfg.epochs * max(1, len(kept) // cfg.batch_size)
    split = Split(seed, torch.zeros(len(kept), dtype=torch.bool))
    members = train_members(kept, [split], steps=steps, batch_size=cfg.batch_size, device=cfg.device)
    policy = ScaledMeanPolicy.of(members.actor_state(0), members.scalings[0])
    options = {"episodes": cfg.evaluation.episodes, "seed": cfg.evaluation.seed, "workers": 0, "progress": False}
    return [row["return"] for row in evaluate_policies({"mode": policy}, env_fn=make_ant, **options)]


def file_of(key: Key, what: str, cfg: DictConfig) -> Path:
    """Where what was found of a cell, or the returns, are kept."""
    folder = Path(cfg.output).absolute() / "cells" / key.trio / f"std_{key.std:g}" / key.task
    return folder / f"{what}_{key.seed}.json"
