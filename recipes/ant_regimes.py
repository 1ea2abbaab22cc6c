"""Where each rating works: experts' noise, gaits, units and conflicting pairs, on PyBullet's Ant.

Trains and evaluates every combination of each grid of the configuration. It may be killed and started again at any
time; what is done is not done twice::

    python recipes/ant_regimes.py
    python recipes/ant_regimes.py part=[both] seeds=[300,301]

The map and the table from a file of raw returns alone::

    python recipes/ant_regimes.py mode=report results=docs/results/regimes.csv pictures=docs/results
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
from figure3_report import read_raw
from omegaconf import DictConfig
from options import check_grids, check_options, check_parts
from regimes_report import report, save_raw


def wanted_of(cfg: DictConfig) -> list[Key]:
    """The policies that are asked for, in the order of the grids."""
    names = list(cfg.grids) if cfg.part is None else as_list(cfg.part)
    unknown = [name for name in names if name not in cfg.grids]
    if unknown:
        raise SystemExit(f"part: no grid {unknown[0]!r}, choose of {', '.join(cfg.grids)}")
    seeds = list(range(cfg.seeds)) if isinstance(cfg.seeds, int) else as_list(cfg.seeds)
    keys = []
    for name in names:
        grid = cfg.grids[name]
        check_names(cfg, grid)
        columns = [as_list(grid[column]) for column in ("trio", "std", "task", "scale")]
        for (trio, std, task, scale), seed, method in product(product(*columns), seeds, as_list(grid.method)):
            keys.append(Key(method, task, float(std), seed, trio, float(scale)))
    return keys


@hydra.main(version_base="1.3", config_path=".", config_name="ant_regimes")
def main(cfg: DictConfig) -> None:
    """Runs and shows, or only shows."""
    start = time.monotonic()
    check_options(cfg)
    check_grids(cfg)
    check_parts(cfg)
    if cfg.mode == "run":
        save_raw(cfg.results, run(cfg, wanted_of(cfg)))
    elif cfg.mode != "report":
        raise SystemExit(f"no mode {cfg.mode!r}: choose run or report")
    text = report(read_raw(cfg.results), Path(cfg.pictures))
    minutes = (time.monotonic() - start) / 60
    print(f"{text}\n{minutes:.1f} minutes; returns in {cfg.results}, the map and regimes.md in {cfg.pictures}")


if __name__ == "__main__":
    main()
