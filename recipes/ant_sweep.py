"""Many policies on the Ant, some as one program: what recipes/ant_figure3.py and recipes/ant_regimes.py share."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from ant_common import TRAINING, demonstrations, task_data
from ant_units import Key, ReturnsTable, Unit, alone_in, key_of, parse, plan
from common import keep_settings, make_rating, make_trainer
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from safetensors.torch import load_file, save_file
from torch import Tensor
from torchrl._utils import logger as torchrl_logger

import torchrl_tsallis.trainers.configs  # noqa: F401 (registers the groups that the YAML file names)
from torchrl_tsallis.data import make_stacked_replay_buffer
from torchrl_tsallis.envs import make_ant
from torchrl_tsallis.evaluation import MeanPolicy, evaluate_policies
from torchrl_tsallis.jobs import atomic_path, run_jobs, run_jobs_on_ray, tick
from torchrl_tsallis.trainers import keep_freed_memory, make_logger, resume


def of_condition(cfg: DictConfig, key: Key) -> DictConfig:
    """The configuration of a policy's data, with paths that hold in any process."""
    cfg = OmegaConf.merge(cfg, {"data": {"std": key.std, "policies": cfg.trios[key.trio]}})
    cfg.output, cfg.data.cache = (str(Path(path).absolute()) for path in (cfg.output, cfg.data.cache))
    return cfg


def table_of(cfg: DictConfig) -> ReturnsTable:
    """The table of returns, which is complete up to the episode that is being run."""
    return ReturnsTable(Path(cfg.output) / "returns.csv")


def train(unit: Unit, cfg: DictConfig) -> None:
    """Trains the policies of a unit, from its newest checkpoint on, and leaves them in its folder.

    Each policy is what recipes/ant_noise.py makes of its seed: data, initial weights and order of samples are equal.
    """
    data: dict[int, Any] = {}
    actors = []
    for _, seed in unit.members:
        torch.manual_seed(seed)
        if seed not in data:
            data[seed] = task_data(unit.condition.task, cfg, seed)
            data[seed]["action"].mul_(unit.condition.scale)
        obs_dim, action_dim = (data[seed][name].shape[1] for name in ("observation", "action"))
        actors.append(instantiate(cfg.policy, obs_dim=obs_dim, action_dim=action_dim))
    seeds = [seed for _, seed in unit.members]
    rating, tuner = make_rating(cfg, [cfg.methods[method] for method, _ in unit.members])
    loss = instantiate(cfg.loss, _partial_=True)(actor_network=actors, rating=rating).to(cfg.device)
    if cfg.compile is not None:
        torch.compiler.reset()  # code of an earlier unit in this process guards a loss that is no more
        loss.compile(**cfg.compile)
    members = [data[seed] for seed in seeds]
    buffer = make_stacked_replay_buffer(members, seeds=seeds, batch_size=cfg.batch_size, device=cfg.device)
    epoch = len(members[0]) // cfg.batch_size
    folder, (_, task, std, *_) = unit.folder, unit.condition
    logger = make_logger(cfg.log, folder, "log", group=f"std_{std:g}/{task}", tags=[task, folder.name])
    options = {"epoch": epoch, "tuner": tuner, "logger": logger, "folder": folder}
    trainer = make_trainer(cfg, loss, buffer, batch_dims=1, **options)
    trainer.register_op("post_steps", tick)
    done = resume(trainer)
    tick(done // epoch)
    if done < trainer.total_frames:
        trainer.train()
    logger.shutdown()
    states = {}
    for member, (method, seed) in enumerate(unit.members):
        for name, value in in_robot_units(loss.member_state_dict(member), unit.condition.scale).items():
            states[f"{method}/{seed}/{name}"] = value.cpu().contiguous()
    with atomic_path(folder / "policies.safetensors") as path:  # it marks the training as done
        save_file(states, path)
    shutil.rmtree(folder / "checkpoints", ignore_errors=True)


def in_robot_units(state: dict[str, Tensor], scale: float) -> dict[str, Tensor]:
    """An actor's state whose mean is divided by the factor of its training data's actions."""
    if scale == 1:
        return state
    last = max((name for name, value in state.items() if value.ndim == 2), key=lambda name: int(name.split(".")[-2]))
    state = dict(state)
    for name in (last, f"{last.removesuffix('weight')}bias"):
        value = state[name].clone()
        value[: len(value) // 2] /= scale
        state[name] = value
    return state


def evaluate(unit: Unit, cfg: DictConfig) -> None:
    """Evaluates the policies of a unit on common seeds, and adds the returns that are missing to the table."""
    states = load_file(unit.folder / "policies.safetensors")
    table = table_of(cfg)
    counts = table.counts()
    for key in unit.keys:
        first, start = counts[key], f"{key.method}/{key.seed}/"
        if first < cfg.evaluation.episodes:
            own = {name.removeprefix(start): value for name, value in states.items() if name.startswith(start)}
            rows = evaluate_policies(
                {key.method: MeanPolicy.from_actor_state(own)},
                env_fn=make_ant,
                episodes=cfg.evaluation.episodes - first,
                seed=cfg.evaluation.seed + first,
                workers=0,  # none but this process
                progress=False,
            )
            table.append(
                [{**key._asdict(), "episode": first + row["episode"], "return": row["return"]} for row in rows]
            )
        tick()


def run_unit(unit: Unit, cfg: DictConfig) -> None:
    """Trains and evaluates a unit, in a process of its own."""
    torchrl_logger.setLevel("ERROR")
    keep_freed_memory()
    cfg = of_condition(cfg, unit.condition)
    if (unit.folder / "policies.safetensors").exists():
        tick(cfg.epochs)
    else:
        train(unit, cfg)
    evaluate(unit, cfg)


def launch(units: list[Unit], cfg: DictConfig) -> None:
    """Runs the units by the launcher that is asked for."""
    total = len(units) * cfg.epochs + sum(len(unit.keys) for unit in units)
    bar = {"total": total, "desc": "training and evaluating", "unit": "step", "progress": cfg.progress}
    job = partial(run_unit, cfg=cfg)
    if cfg.launcher == "ray":
        resources = {"num_cpus": cfg.ray.num_cpus, "num_gpus": cfg.ray.num_gpus}
        run_jobs_on_ray(job, units, address=cfg.ray.address, resources=resources, **bar)
    elif cfg.launcher == "local":
        run_jobs(job, units, workers=cfg.workers, **bar)
    else:
        raise SystemExit(f"no launcher {cfg.launcher!r}: choose local or ray")


def run(cfg: DictConfig, wanted: Sequence[Key]) -> list[dict[str, Any]]:
    """Does what is missing of the policies that are wanted, and returns their rows."""
    output = Path(cfg.output).absolute()
    with alone_in(output):
        for method in dict.fromkeys(key.method for key in wanted):
            settings = OmegaConf.to_container(cfg.methods, resolve=True)
            keep_settings(output / "methods" / f"{method}.json", settings, [method])
        for key in dict.fromkeys(key._replace(method="", task="", seed=0, scale=1.0) for key in wanted):
            one = of_condition(cfg, key)
            settings = OmegaConf.to_container(one, resolve=True) | {"evaluation.seed": one.evaluation.seed}
            file = output / key.trio / f"std_{key.std:g}" / "settings.json"
            keep_settings(file, settings, (*TRAINING, "evaluation.seed"))
            demonstrations(one, cfg.progress)
        if cfg.known is not None:  # what was done elsewhere is not done again
            counts, rows = table_of(cfg).counts(), parse(Path(cfg.known).read_text())
            table_of(cfg).append([row for row in rows if row["episode"] >= counts[key_of(row)]])
        try:
            kind_of = {name: str(method.rating) for name, method in cfg.methods.items()}
            launch(plan(wanted, table_of(cfg), output, cfg.evaluation.episodes, cfg.block, kind_of.__getitem__), cfg)
        except KeyboardInterrupt:
            raise SystemExit("interrupted: the same command goes on from the last checkpoints") from None
    order = {key: place for place, key in enumerate(wanted)}
    rows = [r for r in table_of(cfg).read() if key_of(r) in order and r["episode"] < cfg.evaluation.episodes]
    return sorted(rows, key=lambda row: (order[key_of(row)], row["episode"]))
