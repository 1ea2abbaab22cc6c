"""Imitation of page flipping with recurrent policies (section VI): BC, q-BC and the proposal, in simulation.

One command trains five seeds of each method, lets every policy flip pages ten times, and shows the results::

    python recipes/page_flip.py

Methods and seeds are overrides, one or a list; ``resume=true`` continues an interrupted run::

    python recipes/page_flip.py method=proposal seed=0 epochs=100
"""

from __future__ import annotations

import shutil
import time
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import torch
from collect_flip import collect_flips
from common import as_list, keep_method_settings, make_rating, make_trainer
from flip_report import faults_of, read_rows, report, save_rows
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from options import check_options, check_parts
from safetensors.torch import load_file, save_file
from torchrl._utils import logger as torchrl_logger
from torchrl.modules import set_recurrent_mode

import torchrl_tsallis.trainers.configs  # noqa: F401 (registers the groups that the YAML file names)
from torchrl_tsallis.data import Scaling, make_sequence_buffer, split_trajectories, validate_demonstrations
from torchrl_tsallis.envs import make_page_flip
from torchrl_tsallis.evaluation import RecurrentMeanPolicy, record_rollout, run_flip_trial
from torchrl_tsallis.jobs import atomic_path, run_jobs, tick
from torchrl_tsallis.trainers import EvaluationHook, LoggerGroup, make_logger, resume

Unit = tuple[int, str]  # seed, method: one training
#: The entries of the configuration that decide about a policy and its trials.
SETTINGS = (
    "policy",
    "loss",
    "ratings",
    "tuners",
    "optimizer",
    "updater",
    "data",
    "trials",
    "epochs",
    "slice_len",
    "num_slices",
)


def units_of(cfg: DictConfig) -> list[Unit]:
    """The trainings that are asked for."""
    unknown = [value for value in as_list(cfg.method) if value not in cfg.methods]
    if unknown:
        raise SystemExit(f"no method {unknown[0]!r}: choose one or a list of {', '.join(cfg.methods)}")
    return list(product(as_list(cfg.seed), as_list(cfg.method)))


def folder_of(unit: Unit, cfg: DictConfig) -> Path:
    """Where a training's files are."""
    return Path(cfg.output) / f"seed_{unit[0]}" / unit[1]


def unit_logger(unit: Unit, cfg: DictConfig) -> LoggerGroup:
    """The loggers of a training; opened again, they continue its run."""
    folder = folder_of(unit, cfg)
    return make_logger(cfg.log, folder.parent, unit[1], group=f"page_flip/{unit[1]}", tags=["page_flip", unit[1]])


def demonstrations(cfg: DictConfig, progress: bool = False) -> tuple[Any, Any]:
    """Training and validation data, from the cache or recorded now."""
    data = cfg.data
    settings = {"trajectories": data.trajectories, "seed": data.seed, "steps": data.steps, "workers": cfg.workers}
    found, _ = collect_flips(data.cache, progress=progress, **settings)
    return split_trajectories(found, data.validation, seed=data.seed)


def check_settings(units: list[Unit], cfg: DictConfig) -> None:
    """Keeps each training's settings in its folder; a resumed one must have the same."""
    keep_method_settings(cfg, {folder_of(unit, cfg): unit[-1] for unit in units}, SETTINGS)


def errors(actor: Any, data: Any, unit: float) -> dict[str, float]:
    """Mean squared error of the mean action on scaled trajectories ``[V, T]``, in N^2 a direction."""
    mode = actor.training
    actor.eval()
    with torch.no_grad(), set_recurrent_mode(True):
        written = actor(data.select("observation", "is_init"))
    actor.train(mode)
    return {"mse": (unit * (written["loc"] - data["action"])).square().mean().item()}


def train(unit: Unit, cfg: DictConfig) -> None:
    """Trains one policy, in a process of its own; leaves policy, ratings and logs in its folder."""
    torchrl_logger.setLevel("ERROR")
    seed, method = unit
    folder = folder_of(unit, cfg)
    torch.manual_seed(seed)
    training, validation = demonstrations(cfg)
    scaling = Scaling.fit(training, action_unit=cfg.data.action_unit)
    data, held_out = scaling(training), scaling(validation).reshape(-1, cfg.data.steps)
    actor = instantiate(cfg.policy, obs_dim=data["observation"].shape[1], action_dim=data["action"].shape[1])
    rating, tuner = make_rating(cfg, cfg.methods[method])
    loss = instantiate(cfg.loss, _partial_=True)(actor_network=actor, rating=rating)
    logger = unit_logger(unit, cfg)
    logger.log_hparams({**OmegaConf.to_container(cfg, resolve=True), "seed": seed, "method": method})
    epoch = len(data) // cfg.data.steps // cfg.num_slices
    buffer = make_sequence_buffer(data, slice_len=cfg.slice_len, num_slices=cfg.num_slices, seed=seed)
    trainer = make_trainer(cfg, loss, buffer, epoch=epoch, tuner=tuner, logger=logger, folder=folder)
    measure = partial(errors, actor, held_out, cfg.data.action_unit)
    EvaluationHook(measure, cfg.validate_every * epoch).register(trainer)
    trainer.register_op("post_steps", tick)
    done = resume(trainer) if cfg.resume else 0
    tick(done // epoch)
    if done < trainer.total_frames:
        trainer.train()
    logger.shutdown()
    loss.eval()
    with atomic_path(folder / "ratings.safetensors") as path:
        save_file({"rating": loss.rating(data.reshape(-1, cfg.data.steps)).reshape(-1), **faults_of(training)}, path)
    state = {name: value.contiguous() for name, value in actor.state_dict().items()} | scaling.state_dict()
    with atomic_path(folder / "policy.safetensors") as path:  # last: it marks the training as done
        save_file(state, path)


def flip(unit: Unit, cfg: DictConfig) -> None:
    """Lets one policy flip pages on the common seeds; leaves counts, trajectories and a video in its folder."""
    folder, (seed, method) = folder_of(unit, cfg), unit
    policy = RecurrentMeanPolicy.from_state(load_file(folder / "policy.safetensors"))
    rows, arrays = [], {}
    for number in range(cfg.trials.count):
        trial = run_flip_trial(policy, cfg.trials.seed + number)
        rows.append({"method": method, "seed": seed, "trial": number, **trial.row})
        arrays |= {f"positions_{number}": trial.positions, f"forces_{number}": trial.forces}
        tick()
    with atomic_path(folder / "trials.npz") as path:
        np.savez_compressed(path, **arrays)
    if cfg.video and seed == as_list(cfg.seed)[0]:
        policy.reset()
        settings = {"seconds": 0.02 * cfg.data.steps, "seed": cfg.trials.seed, "env_fn": make_page_flip}
        record_rollout(policy, folder / "rollout.gif", step_seconds=0.02, size=(320, 240), **settings)
    save_rows(folder / "trials.csv", rows)  # last: it marks the trials as done


@hydra.main(version_base="1.3", config_path=".", config_name="page_flip")
def main(cfg: DictConfig) -> None:
    """Records, trains, flips and shows."""
    start = time.monotonic()
    torchrl_logger.setLevel("ERROR")
    check_options(cfg)
    check_parts(cfg)
    units = units_of(cfg)
    folders = {unit: folder_of(unit, cfg) for unit in units}
    if not cfg.resume:
        for folder in folders.values():
            shutil.rmtree(folder, ignore_errors=True)
    check_settings(units, cfg)
    parts = demonstrations(cfg, cfg.progress)
    for part in parts:
        validate_demonstrations(part, action_limit=3.3)
    jobs = {"workers": cfg.workers, "progress": cfg.progress}
    try:
        left = [unit for unit, folder in folders.items() if not (folder / "policy.safetensors").exists()]
        total = len(left) * cfg.epochs
        run_jobs(partial(train, cfg=cfg), left, total=total, desc="training", unit="epoch", **jobs)
        left = [unit for unit, folder in folders.items() if not (folder / "trials.csv").exists()]
        total = len(left) * cfg.trials.count
        run_jobs(partial(flip, cfg=cfg), left, total=total, desc="flipping pages", unit="trial", **jobs)
    except KeyboardInterrupt:
        raise SystemExit("interrupted: the same command with resume=true goes on from the last checkpoint") from None
    rows = [row for folder in folders.values() for row in read_rows(folder / "trials.csv")]
    save_rows(cfg.results, rows)
    epoch = len(parts[0]) // cfg.data.steps // cfg.num_slices
    text = report(rows, Path(cfg.output), Path(cfg.pictures), cfg.log, steps=cfg.data.steps, epoch=epoch)
    minutes = (time.monotonic() - start) / 60
    print(f"\n{text}\n{minutes:.1f} minutes; raw results in {cfg.results}, pictures in {cfg.pictures}")


if __name__ == "__main__":
    main()
