"""Ratings of the paper's methods on demonstrations that their policies did not see, for recipes/curation.py."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from ant_common import ratings_file, task_data
from ant_sweep import of_condition
from ant_units import Key
from common import as_list, make_rating
from hydra.utils import instantiate
from omegaconf import DictConfig
from torchrl import torchrl_logger

from torchrl_tsallis.data import make_stacked_replay_buffer
from torchrl_tsallis.data.episodes import find_episodes
from torchrl_tsallis.data.rows import take_rows
from torchrl_tsallis.jobs import atomic_path, tick
from torchrl_tsallis.run import default_steps
from torchrl_tsallis.runs.members import grain, make_splits


def rejections(data: Any, cfg: DictConfig, methods: Sequence[str], *, seed: int) -> dict[str, np.ndarray]:
    """One minus the rating of each sample, ``samples/...`` ``[N]``, and its mean over each episode ``[E]``.

    Policies take the data in its own units, as the paper's do, for as many steps as those of the surprise.

    Args:
        data: ``observation``, ``action`` and what tells the episodes.
        cfg: of the recipe, with the methods, all of one kind.
        methods: their names.
        seed: of the folds and the policies.
    """
    splits = make_splits(data, seeds=1, folds=cfg.folds)
    rows = data.select("observation", "action")
    dims = {f"{short}_dim": rows[name].shape[1] for short, name in (("obs", "observation"), ("action", "action"))}
    actors = []
    for _ in methods:
        for _ in splits:
            torch.manual_seed(seed)
            actors.append(instantiate(cfg.policy, **dims))
    rating, tuner = make_rating(cfg, [cfg.methods[method] for method in methods for _ in splits])
    loss = instantiate(cfg.loss, _partial_=True)(actor_network=actors, rating=rating).to(cfg.device)
    parts = [take_rows(rows, ~split.held_out) for split in splits] * len(methods)
    buffer = make_stacked_replay_buffer(parts, seeds=[seed] * len(parts), batch_size=cfg.batch_size, device=cfg.device)
    steps = cfg.steps or default_steps(len(data))
    trainer = instantiate(cfg.trainer, _partial_=True)(
        loss=loss,
        replay_buffer=buffer,
        optimizer=instantiate(cfg.optimizer, batch_dims=1),
        updater=instantiate(cfg.updater),
        tuner=tuner,
        logger=None,
        steps=steps,
        log_every=grain(steps),
        checkpoint_dir=None,
        progress=False,
    )
    trainer.train()
    loss.eval()
    wide = rows.to(cfg.device).expand(len(actors), *rows.batch_size)
    rated = loss.rating(wide).cpu().unflatten(0, (len(methods), len(splits)))
    episodes = find_episodes(data, open_end=True)
    number, out = episodes.of_rows(), {}
    for method, of_splits in zip(methods, rated, strict=True):
        rejected = torch.empty(len(rows))
        for split, values in zip(splits, of_splits, strict=True):
            rejected[split.held_out] = 1 - values[split.held_out]
        total = torch.zeros(len(episodes.starts), dtype=torch.float64).index_add_(0, number, rejected.double())
        out[f"samples/rejection_{method}"] = rejected.numpy()
        out[f"rejection_{method}"] = (total / episodes.lengths).numpy()
    return out


def save(file: Path, arrays: dict[str, Any]) -> None:
    """Writes scores and labels, atomically."""
    with atomic_path(file) as path, open(path, "wb") as stream:
        np.savez_compressed(stream, **arrays)


def rate_by_paper(cell: tuple[str, float, int], cfg: DictConfig) -> None:
    """The same by the paper's methods, in a file beside it."""
    torchrl_logger.setLevel("ERROR")
    task, std, seed = cell
    file = paper_file(cell, cfg)
    if not file.exists():
        data = task_data(task, of_condition(cfg, Key("", task, std, seed)), seed)
        data = data.select("observation", "action").set("episode", torch.arange(len(data)) // cfg.data.length)
        save(file, rejections(data, cfg, as_list(cfg.paper), seed=seed))
    tick()


def paper_file(cell: tuple[str, float, int], cfg: DictConfig) -> Path:
    """Where what the paper's methods take for noise is kept."""
    file = ratings_file(cfg, *cell)
    return file.with_name(f"paper_{file.name}")


def scores_of(cell: tuple[str, float, int], cfg: DictConfig) -> dict[str, np.ndarray]:
    """All scores and labels of a cell."""
    files = (ratings_file(cfg, *cell), paper_file(cell, cfg))
    return {name: value for file in files if file.exists() for name, value in np.load(file).items()}
