"""Figure 3 of the paper: 10 methods on 4 tasks, in PyBullet's Ant, over many seeds.

Trains all methods of some seeds of a task as one program, evaluates the policies on common seeds, and draws the figure.
It may be killed and started again at any time, with more seeds or episodes too: what is done is not done twice::

    python recipes/ant_figure3.py seeds=24 std=[0.2,0.25]
    python recipes/ant_figure3.py seeds=24 launcher=ray ray.address=auto ray.num_gpus=0.25 device=cuda

The table and the pictures from a file of raw returns alone::

    python recipes/ant_figure3.py mode=report results=docs/results/ant_figure3.csv.gz pictures=docs/results
"""

from __future__ import annotations

import shutil
import time
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import hydra
import torch
from ant_common import TRAINING, check_names, demonstrations
from ant_units import ReturnsTable, Unit, alone_in, key_of, plan
from common import as_list, keep_settings, make_trainer
from figure3_report import read_raw, report, save_raw
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from safetensors.torch import load_file, save_file
from torchrl._utils import logger as torchrl_logger

import torchrl_tsallis.trainers.configs  # noqa: F401 (registers the groups that the YAML file names)
from torchrl_tsallis._io import atomic_path
from torchrl_tsallis._pool import run_jobs, tick
from torchrl_tsallis._ray import run_jobs_on_ray
from torchrl_tsallis.data import make_stacked_replay_buffer, make_task
from torchrl_tsallis.envs import make_ant
from torchrl_tsallis.evaluation import MeanPolicy, evaluate_policies
from torchrl_tsallis.trainers import keep_freed_memory, make_logger, resume


def with_std(cfg: DictConfig, std: float) -> DictConfig:
    """The configuration of one standard deviation, with paths that hold in any process."""
    cfg = OmegaConf.merge(cfg, {"std": std})
    cfg.output, cfg.data.cache = (str(Path(path).absolute()) for path in (cfg.output, cfg.data.cache))
    return cfg


def wanted_of(cfg: DictConfig) -> list[tuple[str, str, float, int]]:
    """The policies that are asked for: method, task, std, seed."""
    check_names(cfg)
    seeds = list(range(cfg.seeds)) if isinstance(cfg.seeds, int) else as_list(cfg.seeds)
    parts = product(map(float, as_list(cfg.std)), as_list(cfg.task), seeds, as_list(cfg.method))
    return [(method, task, std, seed) for std, task, seed, method in parts]


def table_of(cfg: DictConfig) -> ReturnsTable:
    """The table of returns, which is complete up to the episode that is being run."""
    return ReturnsTable(Path(cfg.output) / "returns.csv")


def train(unit: Unit, cfg: DictConfig) -> None:
    """Trains the policies of a unit, from its newest checkpoint on, and leaves them in its folder.

    Each policy is what recipes/ant_noise.py makes of its seed: data, initial weights and order of samples are equal.
    """
    recorded = demonstrations(cfg)
    data: dict[int, Any] = {}
    actors = []
    for _, seed in unit.members:
        torch.manual_seed(seed)
        if seed not in data:
            data[seed] = make_task(unit.task, *recorded, seed=seed, **cfg.data.noise)
        obs_dim, action_dim = (data[seed][name].shape[1] for name in ("observation", "action"))
        actors.append(instantiate(cfg.policy, obs_dim=obs_dim, action_dim=action_dim))
    seeds = [seed for _, seed in unit.members]
    settings = [cfg.methods[method] for method, _ in unit.members]
    tuned = [bool(method.tune_q) for method in settings]
    levels = {"q": [method.q for method in settings], "gamma_mix": [method.gamma_mix for method in settings]}
    loss = instantiate(cfg.loss, _partial_=True)(actor_network=actors, **levels).to(cfg.device)
    if cfg.compile is not None:
        loss.compile(**cfg.compile)
    members = [data[seed] for seed in seeds]
    buffer = make_stacked_replay_buffer(members, seeds=seeds, batch_size=cfg.batch_size)
    if torch.device(cfg.device).type != "cpu":
        buffer.append_transform(lambda batch: batch.to(cfg.device))
    epoch = len(members[0]) // cfg.batch_size
    folder = unit.folder
    logger = make_logger(cfg.log, folder, "log", group=f"std_{unit.std:g}/{unit.task}", tags=[unit.task, folder.name])
    options = {"epoch": epoch, "tuned": tuned, "logger": logger, "folder": folder}
    trainer = make_trainer(cfg, loss, buffer, batch_dims=1, **options)
    trainer.register_op("post_steps", tick)
    done = resume(trainer)
    tick(done // epoch)
    if done < trainer.total_frames:
        trainer.train()
    logger.shutdown()
    states = {}
    for member, (method, seed) in enumerate(unit.members):
        for name, value in loss.member_state_dict(member).items():
            states[f"{method}/{seed}/{name}"] = value.cpu().contiguous()
    with atomic_path(folder / "policies.safetensors") as path:  # it marks the training as done
        save_file(states, path)
    shutil.rmtree(folder / "checkpoints", ignore_errors=True)


def evaluate(unit: Unit, cfg: DictConfig) -> None:
    """Evaluates the policies of a unit on common seeds, and adds the returns that are missing to the table."""
    states = load_file(unit.folder / "policies.safetensors")
    table = table_of(cfg)
    counts = table.counts()
    for key in unit.keys:
        method, task, std, seed = key
        first, start = counts[key], f"{method}/{seed}/"
        if first < cfg.evaluation.episodes:
            own = {name.removeprefix(start): value for name, value in states.items() if name.startswith(start)}
            rows = evaluate_policies(
                {method: MeanPolicy.from_actor_state(own)},
                env_fn=make_ant,
                episodes=cfg.evaluation.episodes - first,
                seed=cfg.evaluation.seed + first,
                workers=0,  # none but this process
                progress=False,
            )
            facts = {"method": method, "task": task, "std": std, "seed": seed}
            table.append([{**facts, "episode": first + row["episode"], "return": row["return"]} for row in rows])
        tick()


def run_unit(unit: Unit, cfg: DictConfig) -> None:
    """Trains and evaluates a unit, in a process of its own."""
    torchrl_logger.setLevel("ERROR")
    keep_freed_memory()
    cfg = with_std(cfg, unit.std)
    if (unit.folder / "policies.safetensors").exists():
        tick(cfg.epochs)
    else:
        train(unit, cfg)
    evaluate(unit, cfg)


def launch(units: list[Unit], cfg: DictConfig) -> None:
    """Runs the units by the launcher that is asked for."""
    total = len(units) * cfg.epochs + sum(len(unit.members) for unit in units)
    bar = {"total": total, "desc": "training and evaluating", "unit": "step", "progress": cfg.progress}
    job = partial(run_unit, cfg=cfg)
    if cfg.launcher == "ray":
        resources = {"num_cpus": cfg.ray.num_cpus, "num_gpus": cfg.ray.num_gpus}
        run_jobs_on_ray(job, units, address=cfg.ray.address, resources=resources, **bar)
    elif cfg.launcher == "local":
        run_jobs(job, units, workers=cfg.workers, **bar)
    else:
        raise SystemExit(f"no launcher {cfg.launcher!r}: choose local or ray")


def run(cfg: DictConfig) -> list[dict[str, Any]]:
    """Does what is missing, and returns the rows of what is asked for."""
    wanted, output, methods = wanted_of(cfg), Path(cfg.output).absolute(), as_list(cfg.method)
    with alone_in(output):
        for std in dict.fromkeys(key[2] for key in wanted):
            one = with_std(cfg, std)
            settings = OmegaConf.to_container(one, resolve=True) | {"evaluation.seed": one.evaluation.seed}
            keep_settings(output / f"std_{std:g}" / "settings.json", settings, (*TRAINING, "evaluation.seed"))
            for method in methods:
                keep_settings(output / "methods" / f"{method}.json", settings["methods"], [method])
            demonstrations(one, cfg.progress)
        try:
            launch(plan(wanted, table_of(cfg), output, cfg.evaluation.episodes, cfg.block), cfg)
        except KeyboardInterrupt:
            raise SystemExit("interrupted: the same command goes on from the last checkpoints") from None
    order = {key: place for place, key in enumerate(wanted)}
    rows = [r for r in table_of(cfg).read() if key_of(r) in order and r["episode"] < cfg.evaluation.episodes]
    return sorted(rows, key=lambda row: (order[key_of(row)], row["episode"]))


@hydra.main(version_base="1.3", config_path=".", config_name="ant_figure3")
def main(cfg: DictConfig) -> None:
    """Runs and shows, or only shows."""
    start = time.monotonic()
    if cfg.mode == "run":
        save_raw(cfg.results, run(cfg))
    elif cfg.mode != "report":
        raise SystemExit(f"no mode {cfg.mode!r}: choose run or report")
    text = report(read_raw(cfg.results), Path(cfg.pictures))
    minutes = (time.monotonic() - start) / 60
    print(f"{text}\n{minutes:.1f} minutes; returns in {cfg.results}, the figure and figure3.md in {cfg.pictures}")


if __name__ == "__main__":
    main()
