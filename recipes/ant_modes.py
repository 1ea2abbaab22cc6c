"""Whose demonstrations are these? Modes among demonstrations on PyBullet's Ant, and what their policies are worth.

Finds modes without labels, trains a policy of each mode that is large enough, and evaluates all of them. It may be
killed and started again; what is done is not done twice::

    python recipes/ant_modes.py
    python recipes/ant_modes.py part=[gaits] seeds=[200,201]

The tables from the raw files alone::

    python recipes/ant_modes.py mode=report results=docs/results
"""

from __future__ import annotations

import json
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import hydra
import torch
from ant_common import check_names, demonstrations, task_data
from ant_sweep import of_condition
from ant_units import Key
from common import as_list, keep_settings
from modes_report import read_rows, report, write_rows
from omegaconf import DictConfig, OmegaConf
from torchrl import torchrl_logger

from torchrl_tsallis.data import find_episodes
from torchrl_tsallis.data.rows import take_rows
from torchrl_tsallis.envs import make_ant
from torchrl_tsallis.evaluation import evaluate_policies
from torchrl_tsallis.jobs import atomic_path, run_jobs, tick
from torchrl_tsallis.modes import find_modes
from torchrl_tsallis.runs.members import Split, train_members
from torchrl_tsallis.runs.policies import ScaledMeanPolicy
from torchrl_tsallis.trainers import keep_freed_memory

#: Options that decide about a cell's result.
SETTINGS = ("search", "smallest", "updates", "epochs", "batch_size", "data", "evaluation")


def labels_of(data: Any, starts: torch.Tensor, amateur: int) -> list[int]:
    """Who demonstrated each episode; the amateur is the last."""
    info, names = data["info"], set(data["info"].keys())
    expert = info["expert"][starts].reshape(-1)
    by_amateur = info["is_amateur"][starts].reshape(-1) if "is_amateur" in names else expert < 0
    return expert.where(~by_amateur, torch.full_like(expert, amateur)).tolist()


def search(key: Key, cfg: DictConfig) -> None:
    """Finds the modes of one cell and seed, and evaluates a policy of each, in a process of its own."""
    torchrl_logger.setLevel("ERROR")
    keep_freed_memory()
    file = file_of(key, cfg)
    if not file.exists():
        data = task_data(key.task, of_condition(cfg, key), key.seed)
        rows = data.select("observation", "action").set("episode", torch.arange(len(data)) // cfg.data.length)
        starts = find_episodes(rows).starts
        found = find_modes(rows, **cfg.search, updates=cfg.updates, batch_size=cfg.batch_size, seed=key.seed)
        modes, episode = found.of_episodes, rows["episode"]
        large = [k for k, group in enumerate(found.groups) if len(group) >= cfg.smallest or k == found.recommended]
        returns = {k: evaluated(rows, modes[episode] != k, key.seed, cfg) for k in large}
        member = found.membership[modes, torch.arange(len(modes))]
        answer = {
            "agreement": found.agreement,
            "recommended": found.recommended,
            "mode": modes.tolist(),
            "membership": member.tolist(),
            "expert": labels_of(data, starts, len(cfg.trios[key.trio]) - 1),
            "returns": returns,
        }
        with atomic_path(file) as path:
            path.write_text(json.dumps(answer))
    tick()


def evaluated(rows: Any, left_out: torch.Tensor, seed: int, cfg: DictConfig) -> list[float]:
    """Returns of the policy that is trained on the other rows, for as many passes over them as those of a recipe."""
    kept = take_rows(rows, ~left_out)
    steps = cfg.epochs * max(1, len(kept) // cfg.batch_size)
    split = Split(seed, torch.zeros(len(kept), dtype=torch.bool))
    members = train_members(kept, [split], steps=steps, batch_size=cfg.batch_size, device=cfg.device)
    policy = ScaledMeanPolicy.of(members.actor_state(0), members.scalings[0])
    options = {"episodes": cfg.evaluation.episodes, "seed": cfg.evaluation.seed, "workers": 0, "progress": False}
    return [row["return"] for row in evaluate_policies({"mode": policy}, env_fn=make_ant, **options)]


def file_of(key: Key, cfg: DictConfig) -> Path:
    """Where a cell's answer is kept."""
    return Path(cfg.output).absolute() / "cells" / key.trio / f"std_{key.std:g}" / key.task / f"seed_{key.seed}.json"


def wanted_of(cfg: DictConfig) -> list[Key]:
    """The cells and seeds that are asked for, each once."""
    names = list(cfg.cells) if cfg.part is None else as_list(cfg.part)
    unknown = [name for name in names if name not in cfg.cells]
    if unknown:
        raise SystemExit(f"no cells {unknown[0]!r}: choose of {', '.join(cfg.cells)}")
    keys = []
    for name in names:
        check_names(cfg, OmegaConf.create({"task": cfg.cells[name].task, "method": list(cfg.methods)}))
        columns = [as_list(cfg.cells[name][column]) for column in ("trio", "task", "std")]
        keys += [
            Key("modes", task, float(std), seed, trio) for trio, task, std in product(*columns) for seed in cfg.seeds
        ]
    return list(dict.fromkeys(keys))


def run(cfg: DictConfig, keys: list[Key]) -> None:
    """Does what is missing of them."""
    settings = OmegaConf.to_container(cfg, resolve=True)
    keep_settings(Path(cfg.output) / "settings.json", settings, SETTINGS)
    for key in dict.fromkeys(key._replace(task="", seed=0) for key in keys):  # recorded once, not by each worker
        demonstrations(of_condition(cfg, key), cfg.progress)
    bar = {"desc": "finding modes", "unit": "cell", "progress": cfg.progress, "workers": cfg.workers}
    try:
        run_jobs(partial(search, cfg=cfg), keys, total=len(keys), **bar)
    except KeyboardInterrupt:
        raise SystemExit("interrupted: the same command goes on with what is missing") from None


@hydra.main(version_base="1.3", config_path=".", config_name="ant_modes")
def main(cfg: DictConfig) -> None:
    """Runs and shows, or only shows."""
    results = Path(cfg.results)
    if cfg.mode == "run":
        keys = wanted_of(cfg)
        run(cfg, keys)
        write_rows(results, {key: json.loads(file_of(key, cfg).read_text()) for key in keys})
    elif cfg.mode != "report":
        raise SystemExit(f"no mode {cfg.mode!r}: choose run or report")
    print(report(*read_rows(results), results, known=Path(cfg.known)))
    print(f"raw returns, assignments and tables in {results}")


if __name__ == "__main__":
    main()
