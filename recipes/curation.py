"""Does the surprise find what is wrong with demonstrations, and what is dropping it worth? On PyBullet's Ant.

Rates the demonstrations of each task and noise by policies that did not see them, as ``tsallis rate`` does, compares
surprise, rating and the simple signals with the labels, and trains policies without what they would drop. It may be
killed and started again; what is done is not done twice::

    python recipes/curation.py
    python recipes/curation.py "human={door: path/to/door_human.npz}" curated=null

The tables from the raw files alone::

    python recipes/curation.py mode=report results=docs/results
"""

from __future__ import annotations

from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import torch
from ant_common import demonstrations, ratings_file, task_data
from ant_sweep import of_condition, run
from ant_units import Key
from collect_flip import collect_flips
from curation_paper import rate_by_paper, save, scores_of
from curation_report import COLUMNS, read_rows, report, write_rows
from curation_scores import of_human, of_labels, rated
from omegaconf import DictConfig
from options import check_options, check_parts, check_text, listed, one_seed, share, size
from regimes_report import save_raw
from torchrl import torchrl_logger

from torchrl_tsallis.jobs import run_jobs, tick

Cell = tuple[str, float, int]  # task, std, seed
FLIPS = "page_flip"
#: Options of the policies without some episodes, and those of another kind than elsewhere.
CURATED = {
    "curated.tasks": listed(check_text),
    "curated.stds": listed(size),
    "curated.seeds": listed(one_seed),
    "curated.rules": listed(check_text),
    "curated.share": share,
    "curated.methods": listed(check_text),
}


def rate_cell(cell: Cell, cfg: DictConfig) -> None:
    """Rates the demonstrations of one task, noise and seed, in a process of its own."""
    torchrl_logger.setLevel("ERROR")
    task, std, seed = cell
    file = ratings_file(cfg, task, std, seed)
    if not file.exists():
        if task == FLIPS:
            data, length = collect_flips(cfg.flips, progress=False)[0], 500
        else:
            data, length = task_data(task, of_condition(cfg, Key("", task, std, seed)), seed), cfg.data.length
        info, names = data["info"], set(data["info"].keys())
        data = data.select("observation", "action").set("episode", torch.arange(len(data)) // length)
        known = {name: info[name].numpy() for name in ("is_noise", "is_amateur") if name in names}
        if "ep_return" in names:
            known["ep_return"] = info["ep_return"][::length].numpy()
        save(file, rated(data, seed=seed, folds=cfg.folds, steps=cfg.steps) | known)
    tick()


def rate_file(item: tuple[str, str, int], cfg: DictConfig) -> None:
    """Rates the demonstrations of a file with rewards by one seed."""
    from torchrl_tsallis.runs.source import load_source

    torchrl_logger.setLevel("ERROR")
    name, source, seed = item
    file = ratings_file(cfg, name, 0.0, seed)
    if not file.exists():
        data = load_source(source).data
        scores = rated(data, seed=seed, folds=cfg.folds, steps=cfg.steps)
        number = torch.as_tensor(scores["episode_of_rows"])
        totals = torch.zeros(int(number.max()) + 1, dtype=torch.float64)
        totals.index_add_(0, number, data["next", "reward"].reshape(-1).double())
        save(file, scores | {"ep_return": totals.numpy()})
    tick()


def cells_of(grid: Any) -> list[Cell]:
    """The combinations of a grid."""
    return [(task, float(std), seed) for task, std, seed in product(grid.tasks, grid.stds, grid.seeds)]


def detect(cfg: DictConfig) -> list[dict[str, Any]]:
    """Rates everything that is asked for; rows of the scores' qualities."""
    asked = cells_of(cfg)
    cells = list(dict.fromkeys(asked + (cells_of(cfg.curated) if cfg.curated is not None else [])))
    for std in dict.fromkeys(std for _, std, _ in cells):  # the data is recorded once, not by each worker
        demonstrations(of_condition(cfg, Key("", "", std, 0)), cfg.progress)
    if cfg.flips is not None:
        collect_flips(cfg.flips, workers=cfg.workers, progress=cfg.progress)
        cells += [(FLIPS, 0.0, seed) for seed in cfg.seeds]
    bar = {"desc": "rating", "unit": "seed", "progress": cfg.progress, "workers": cfg.workers}
    run_jobs(partial(rate_cell, cfg=cfg), cells, total=len(cells), **bar)
    if cfg.paper:
        bar |= {"desc": "rating by the paper's methods"}
        run_jobs(partial(rate_by_paper, cfg=cfg), asked, total=len(asked), **bar)
    files = [(name, path, seed) for name, path in (cfg.human or {}).items() for seed in cfg.seeds]
    run_jobs(partial(rate_file, cfg=cfg), files, total=len(files), **bar)
    rows = []
    for task, std, seed in cells:
        scores = scores_of((task, std, seed), cfg)
        rows += [{"data": task, "std": std, "seed": seed, **row} for row in of_labels(scores)]
    for name, _, seed in files:
        scores = dict(np.load(ratings_file(cfg, name, 0.0, seed)))
        rows += [{"data": name, "std": 0.0, "seed": seed, **row} for row in of_human(scores)]
    return rows


def wanted_of(cfg: DictConfig) -> list[Key]:
    """The policies that are trained on curated demonstrations."""
    curated = cfg.curated
    tasks = [f"{task}@{rule}" for task, rule in product(curated.tasks, curated.rules)]
    cells = product(curated.stds, tasks, curated.seeds, curated.methods)
    return [Key(method, task, float(std), seed) for std, task, seed, method in cells]


@hydra.main(version_base="1.3", config_path=".", config_name="curation")
def main(cfg: DictConfig) -> None:
    """Runs and shows, or only shows."""
    check_options(cfg, CURATED if cfg.curated is not None else {})
    check_parts(cfg)
    results = Path(cfg.results)
    if cfg.mode == "run":
        write_rows(results / "curation.csv", detect(cfg))
        if cfg.curated is not None:
            save_raw(results / "curation_returns.csv", run(cfg, wanted_of(cfg)))
    elif cfg.mode != "report":
        raise SystemExit(f"no mode {cfg.mode!r}: choose run or report")
    print(report(read_rows(results / "curation.csv"), results, whole=Path(cfg.whole)))
    print(f"raw files and tables in {results}; columns {', '.join(COLUMNS)}")


if __name__ == "__main__":
    main()
