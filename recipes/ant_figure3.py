"""Figure 3 of the paper: 10 methods on 4 tasks, in PyBullet's Ant, over many seeds.

Trains all methods of some seeds of a task as one program, evaluates the policies on common seeds, and draws the figure.
It may be killed and started again at any time, with more seeds or episodes too: what is done is not done twice::

    python recipes/ant_figure3.py seeds=24 std=[0.2,0.25]
    python recipes/ant_figure3.py seeds=24 launcher=ray ray.address=auto ray.num_gpus=0.25 device=cuda

The table and the pictures from a file of raw returns alone::

    python recipes/ant_figure3.py mode=report results=docs/results/ant_figure3.csv.gz pictures=docs/results
"""

from __future__ import annotations

import time
from itertools import product
from pathlib import Path

import hydra
from ant_common import check_names
from ant_sweep import run
from ant_units import Key
from common import as_list
from figure3_report import read_raw, report, save_raw
from omegaconf import DictConfig
from options import check_options, check_parts


def wanted_of(cfg: DictConfig) -> list[Key]:
    """The policies that are asked for."""
    check_names(cfg)
    seeds = list(range(cfg.seeds)) if isinstance(cfg.seeds, int) else as_list(cfg.seeds)
    parts = product(map(float, as_list(cfg.std)), as_list(cfg.task), seeds, as_list(cfg.method))
    return [Key(method, task, std, seed) for std, task, seed, method in parts]


@hydra.main(version_base="1.3", config_path=".", config_name="ant_figure3")
def main(cfg: DictConfig) -> None:
    """Runs and shows, or only shows."""
    start = time.monotonic()
    check_options(cfg)
    check_parts(cfg)
    if cfg.mode == "run":
        save_raw(cfg.results, run(cfg, wanted_of(cfg)))
    elif cfg.mode != "report":
        raise SystemExit(f"no mode {cfg.mode!r}: choose run or report")
    text = report(read_raw(cfg.results), Path(cfg.pictures))
    minutes = (time.monotonic() - start) / 60
    print(f"{text}\n{minutes:.1f} minutes; returns in {cfg.results}, the figure and figure3.md in {cfg.pictures}")


if __name__ == "__main__":
    main()
