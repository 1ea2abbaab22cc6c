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
from torchrl_tsallis.data.robust_scaling import RobustScaling
from torchrl_tsallis.envs import make_ant
from torchrl_tsallis.evaluation import evaluate_policies, record_rollout
from torchrl_tsallis.jobs import atomic_path, tick
from torchrl_tsallis.modes import Modes, find_modes, find_modes_of_each
from torchrl_tsallis.runs.members import Split, train_members
from torchrl_tsallis.runs.policies import ScaledMeanPolicy
from torchrl_tsallis.runs.saved import load_tensors, save_tensors
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
    """Finds what the starts agree on in some cells, as one program, in a process of its own."""
    quiet()
    keys = tuple(key for key in keys if not file_of(key, "modes", cfg).exists())
    sets = [data_of(key, cfg) for key in keys]
    if cfg.by == "policies":
        options = {"updates": cfg.updates, "batch_size": cfg.batch_size, "device": cfg.device, **cfg.search}
        options |= {"threshold": cfg.threshold, "seeds": [key.seed for key in keys]}
        each = find_modes_of_each(sets, **options) if keys else []
    else:
        each = [find_modes(rows, threshold=cfg.threshold) for rows in sets]
    for key, found, rows in zip(keys, each, sets, strict=True):
        answer = {**vars(found), "pairs": found.pairs.tolist(), "membership": found.membership.tolist()}
        write(file_of(key, "modes", cfg), answer | {"expert": rows["expert"][find_episodes(rows).starts].tolist()})
    tick()


def found_in(key: Key, cfg: DictConfig) -> tuple[Modes, list[int]]:
    """The modes of a cell, and the demonstrator of each episode."""
    answer = json.loads(file_of(key, "modes", cfg).read_text())
    expert, groups = answer.pop("expert"), tuple(map(tuple, answer.pop("groups")))
    numbers = {name: torch.tensor(answer.pop(name), dtype=torch.float64) for name in ("pairs", "membership")}
    return Modes(groups, **numbers, **answer), expert


def train(keys: tuple[Key, ...], cfg: DictConfig) -> None:
    """Trains a policy of each large mode of some cells, as one program, in a process of its own."""
    quiet()
    keys = tuple(key for key in keys if not file_of(key, "policies", cfg, "safetensors").exists())
    sets = [data_of(key, cfg) for key in keys]
    total, start = sum(map(len, sets)), 0
    splits, owners = [], []
    for key, rows in zip(keys, sets, strict=True):
        found, _ = found_in(key, cfg)
        for k, group in enumerate(found.groups):
            if len(group) >= cfg.smallest or k == found.recommended:
                held_out = torch.ones(total, dtype=torch.bool)
                held_out[start : start + len(rows)] = found.of_episodes[rows["episode"]] != k
                splits.append(Split(key.seed, held_out))
                owners.append((key, k))
        start += len(rows)
    if keys:
        together = torch.cat([rows.select("observation", "action") for rows in sets])
        members = train_members(together, splits, steps=cfg.steps, batch_size=cfg.batch_size, device=cfg.device)
        state: dict[Key, dict[str, torch.Tensor]] = {key: {} for key in keys}
        for member, (key, k) in enumerate(owners):
            parts = {"actor": members.actor_state(member), "scaling": members.scalings[member].state_dict()}
            for part, values in parts.items():
                state[key] |= {f"{k}:{part}:{name}": value for name, value in values.items()}
        for key in keys:
            save_tensors(file_of(key, "policies", cfg, "safetensors"), state[key])
    tick()


def policies_of(key: Key, cfg: DictConfig) -> dict[str, ScaledMeanPolicy]:
    """The policies of a cell's modes."""
    state: dict[str, dict[str, dict[str, torch.Tensor]]] = {}
    for name, value in load_tensors(file_of(key, "policies", cfg, "safetensors")).items():
        mode, part, rest = name.split(":")
        state.setdefault(mode, {}).setdefault(part, {})[rest] = value
    return {
        mode: ScaledMeanPolicy.of(own["actor"], RobustScaling.from_state_dict(own["scaling"]))
        for mode, own in state.items()
    }


def evaluate(key: Key, cfg: DictConfig) -> None:
    """Lets the policies of a cell's modes walk, in a process of its own."""
    quiet()
    file = file_of(key, "returns", cfg)
    if not file.exists():
        policies = policies_of(key, cfg)
        options = {"episodes": cfg.evaluation.episodes, "seed": cfg.evaluation.seed, "workers": 0, "progress": False}
        returns: dict[str, list[float]] = {mode: [] for mode in policies}
        for row in evaluate_policies(policies, env_fn=make_ant, **options):
            returns[row["policy"]].append(row["return"])
        write(file, returns)
    tick()


def film(key: Key, cfg: DictConfig) -> None:
    """A video of each mode's policy, in a process of its own."""
    quiet()
    for mode, policy in policies_of(key, cfg).items():
        place = Path(cfg.results).absolute() / f"{key.method}_{key.trio}_{key.task}_{key.std:g}_{key.seed}_{mode}.gif"
        options = {"seconds": cfg.film_seconds, "seed": cfg.evaluation.seed, "step_seconds": 0.0165}
        record_rollout(policy, place, env_fn=make_ant, size=(240, 180), **options)
    tick()


def answer_of(key: Key, cfg: DictConfig) -> dict[str, Any]:
    """All that was found of a cell."""
    found, expert = found_in(key, cfg)
    answer = {"evidence": found.evidence, "recommended": found.recommended, "mode": found.of_episodes.tolist()}
    answer |= {"membership": found.membership.tolist(), "expert": expert}
    return answer | {"returns": json.loads(file_of(key, "returns", cfg).read_text())}


def data_of(key: Key, cfg: DictConfig) -> Any:
    """A cell's demonstrations, with the episode and the demonstrator of each row; the amateur is the last one."""
    data = task_data(key.task, of_condition(cfg, key), key.seed)
    rows = data.select("observation", "action").set("episode", torch.arange(len(data)) // cfg.data.length)
    return rows.set("expert", labels_of(data, len(cfg.trios[key.trio]) - 1))


def file_of(key: Key, what: str, cfg: DictConfig, ending: str = "json") -> Path:
    """Where what was found of a cell, or the returns, are kept."""
    folder = Path(cfg.output).absolute() / "cells" / key.method / key.trio / f"std_{key.std:g}" / key.task
    return folder / f"{what}_{key.seed}.{ending}"
