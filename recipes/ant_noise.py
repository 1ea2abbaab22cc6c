"""Imitation of noisy PyBullet Ant demonstrations (section V): plain BC against this method.

The default run trains BC, q-BC, the proposal and the peak rating on the task with both noises, and evaluates them::

    python recipes/ant_noise.py

Methods, tasks and seeds are overrides, one or a list; ``resume=true`` continues an interrupted run::

    python recipes/ant_noise.py method=q_bc q=0.95 task=artificial seed=3
    python recipes/ant_noise.py task=[clean,artificial,amateur,both] seed=[0,1,2] resume=true
"""

from __future__ import annotations

import shutil
import time
from functools import partial
from itertools import product
from pathlib import Path

import hydra
import torch
from ant_common import TRAINING, check_names, demonstrations, task_data
from ant_report import kinds_of, read_returns, report, save_returns
from common import as_list, keep_method_settings, make_rating, make_trainer, save_as_run
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from options import check_options, check_parts
from safetensors.torch import load_file, save_file
from torchrl._utils import logger as torchrl_logger

import torchrl_tsallis.trainers.configs  # noqa: F401 (registers the groups that the YAML file names)
from torchrl_tsallis.data import make_replay_buffer, validate_demonstrations
from torchrl_tsallis.envs import make_ant
from torchrl_tsallis.evaluation import MeanPolicy, evaluate_policies, median, record_rollout
from torchrl_tsallis.jobs import atomic_path, run_jobs, tick
from torchrl_tsallis.trainers import LoggerGroup, make_logger, resume

STEP_SECONDS = 0.0165  # s of the Ant's simulated time
Unit = tuple[str, int, str]  # task, seed, method: one training


def units_of(cfg: DictConfig) -> list[Unit]:
    """The trainings that are asked for."""
    check_names(cfg)
    return list(product(as_list(cfg.task), as_list(cfg.seed), as_list(cfg.method)))


def folder_of(unit: Unit, cfg: DictConfig) -> Path:
    """Where a training's files are."""
    task, seed, method = unit
    return Path(cfg.output) / task / f"seed_{seed}" / method


def unit_logger(unit: Unit, cfg: DictConfig) -> LoggerGroup:
    """The loggers of a training; opened again, they continue its run."""
    task, _, method = unit
    folder = folder_of(unit, cfg)
    return make_logger(cfg.log, folder.parent, method, group=f"{task}/{method}", tags=[task, method])


def check_settings(units: list[Unit], cfg: DictConfig) -> None:
    """Keeps each training's settings in its folder; a resumed one must have the same."""
    keep_method_settings(cfg, {folder_of(unit, cfg): unit[-1] for unit in units}, (*TRAINING, "evaluation"))


def train(unit: Unit, cfg: DictConfig) -> None:
    """Trains one policy, in a process of its own; leaves policy, ratings and logs in its folder."""
    torchrl_logger.setLevel("ERROR")
    task, seed, method = unit
    folder = folder_of(unit, cfg)
    torch.manual_seed(seed)
    data = task_data(task, cfg, seed)
    actor = instantiate(cfg.policy, obs_dim=data["observation"].shape[1], action_dim=data["action"].shape[1])
    rating, tuner = make_rating(cfg, cfg.methods[method])
    loss = instantiate(cfg.loss, _partial_=True)(actor_network=actor, rating=rating)
    logger = unit_logger(unit, cfg)
    logger.log_hparams({**OmegaConf.to_container(cfg, resolve=True), "task": task, "seed": seed, "method": method})
    epoch = len(data) // cfg.batch_size
    buffer = make_replay_buffer(data, batch_size=cfg.batch_size, seed=seed)
    trainer = make_trainer(cfg, loss, buffer, epoch=epoch, tuner=tuner, logger=logger, folder=folder)
    trainer.register_op("post_steps", tick)
    done = resume(trainer) if cfg.resume else 0
    tick(done // epoch)
    if done < trainer.total_frames:
        trainer.train()
    rating = loss.rating(data)
    for kind, mask in kinds_of(data).items():
        logger.log_histogram(f"rating/{kind}", rating[mask], step=trainer.collected_frames)
    logger.shutdown()
    with atomic_path(folder / "ratings.safetensors") as path:
        save_file({"rating": rating, **kinds_of(data)}, path)
    about = {"task": task, "std": cfg.data.std}
    save_as_run(
        folder, cfg, loss, actor, data, about=about, seed=seed, command=f"recipes/ant_noise.py {about} {method}"
    )


def evaluate(units: list[Unit], cfg: DictConfig) -> None:
    """Evaluates policies on common seeds; leaves raw returns, and a video of each first seed, in their folders."""
    for task, seed in dict.fromkeys(unit[:2] for unit in units):
        folders = {unit[2]: folder_of(unit, cfg) for unit in units if unit[:2] == (task, seed)}
        states = {method: load_file(folder / "policy.safetensors") for method, folder in folders.items()}
        policies = {method: MeanPolicy.from_actor_state(state) for method, state in states.items()}
        rows = evaluate_policies(
            policies, env_fn=make_ant, workers=cfg.workers, progress=cfg.progress, **cfg.evaluation
        )
        for method, folder in folders.items():
            own = [{**row, "method": method, "task": task, "seed": seed} for row in rows if row["policy"] == method]
            logger = unit_logger((task, seed, method), cfg)
            logger.log_scalar("eval/return_median", median([row["return"] for row in own]))
            if cfg.video and seed == as_list(cfg.seed)[0]:
                video = {"env_fn": make_ant, "step_seconds": STEP_SECONDS}
                logger.log_video("eval/video", record_rollout(policies[method], folder / "rollout.gif", **video))
            logger.shutdown()
            save_returns(folder / "returns.csv", own)


@hydra.main(version_base="1.3", config_path=".", config_name="ant_noise")
def main(cfg: DictConfig) -> None:
    """Records, trains, evaluates and shows."""
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
    experts, _ = demonstrations(cfg, cfg.progress)
    validate_demonstrations(experts, action_limit=1.0 if cfg.data.clip else 1.0 + 6.0 * cfg.data.std)
    try:
        open_units = [unit for unit, folder in folders.items() if not (folder / "policy.safetensors").exists()]
        total = len(open_units) * cfg.epochs
        bar = {"total": total, "desc": "training", "unit": "epoch", "progress": cfg.progress}
        run_jobs(partial(train, cfg=cfg), open_units, workers=cfg.workers, **bar)
        evaluate([unit for unit, folder in folders.items() if not (folder / "returns.csv").exists()], cfg)
    except KeyboardInterrupt:
        raise SystemExit("interrupted: the same command with resume=true goes on from the last checkpoint") from None
    rows = [row for folder in folders.values() for row in read_returns(folder / "returns.csv")]
    save_returns(cfg.results, rows)
    text = report(rows, Path(cfg.output), Path(cfg.pictures), cfg.log)
    minutes = (time.monotonic() - start) / 60
    print(f"\n{text}\n{minutes:.1f} minutes; returns in {cfg.results}, pictures in {cfg.pictures}")


if __name__ == "__main__":
    main()
