"""Whose demonstrations are these? Modes among demonstrations on PyBullet's Ant, and what their policies are worth.

Finds modes without labels, trains a policy of each mode that is large enough, and evaluates all of them. It may be
killed and started again; what is done is not done twice::

    python recipes/ant_modes.py
    python recipes/ant_modes.py part=[gaits] seeds=[200,201]

By mixtures of policies, into the same tables; on a GPU many cells are one program, and the policies may walk elsewhere,
where the same folder is::

    python recipes/ant_modes.py by=policies mode=train device=cuda block=15 workers=6 output=outputs/ant_mixtures
    python recipes/ant_modes.py by=policies output=outputs/ant_mixtures results=outputs/ant_modes

A video of each mode's policy::

    python recipes/ant_modes.py mode=film part=[gaits] seeds=[200]

The tables from the raw files alone::

    python recipes/ant_modes.py mode=report results=docs/results
"""

from __future__ import annotations

from functools import partial
from itertools import product
from pathlib import Path

import hydra
from ant_common import check_names, demonstrations
from ant_sweep import of_condition
from ant_units import Key
from common import as_list, keep_settings
from modes_cell import answer_of, evaluate, film, search, train
from modes_report import read_rows, report, write_rows
from omegaconf import DictConfig, OmegaConf

from torchrl_tsallis.jobs import run_jobs

#: Names in the tables of what modes are found by.
METHODS = {"distributions": "modes", "policies": "mixtures"}
#: Options that decide about a cell's result.
SETTINGS = ("by", "search", "threshold", "smallest", "updates", "steps", "batch_size", "data", "evaluation")


def wanted_of(cfg: DictConfig) -> list[Key]:
    """The cells and seeds that are asked for, each once."""
    if cfg.by not in METHODS:
        raise SystemExit(f"no by={cfg.by!r}: choose of {', '.join(METHODS)}")
    names = list(cfg.cells) if cfg.part is None else as_list(cfg.part)
    unknown = [name for name in names if name not in cfg.cells]
    if unknown:
        raise SystemExit(f"no cells {unknown[0]!r}: choose of {', '.join(cfg.cells)}")
    keys = []
    for name in names:
        check_names(cfg, OmegaConf.create({"task": cfg.cells[name].task, "method": list(cfg.methods)}))
        columns = [as_list(cfg.cells[name][column]) for column in ("trio", "task", "std")]
        keys += [
            Key(METHODS[cfg.by], task, float(std), seed, trio)
            for trio, task, std in product(*columns)
            for seed in cfg.seeds
        ]
    return list(dict.fromkeys(keys))


def run(cfg: DictConfig, keys: list[Key]) -> None:
    """Does what is missing of them."""
    settings = OmegaConf.to_container(cfg, resolve=True)
    keep_settings(Path(cfg.output) / "settings.json", settings, SETTINGS)
    for key in dict.fromkeys(key._replace(task="", seed=0) for key in keys):  # recorded once, not by each worker
        demonstrations(of_condition(cfg, key), cfg.progress)
    jobs = [tuple(keys[k : k + cfg.block]) for k in range(0, len(keys), cfg.block)]
    bar = {"unit": "cell", "progress": cfg.progress, "workers": cfg.workers}
    try:
        run_jobs(partial(search, cfg=cfg), jobs, total=len(jobs), desc="finding modes", **bar)
        run_jobs(partial(train, cfg=cfg), jobs, total=len(jobs), desc="training policies", **bar)
        if cfg.mode == "film":
            run_jobs(partial(film, cfg=cfg), keys, total=len(keys), desc="filming", **bar)
        if cfg.mode == "run":
            run_jobs(partial(evaluate, cfg=cfg), keys, total=len(keys), desc="letting them walk", **bar)
    except KeyboardInterrupt:
        raise SystemExit("interrupted: the same command goes on with what is missing") from None


@hydra.main(version_base="1.3", config_path=".", config_name="ant_modes")
def main(cfg: DictConfig) -> None:
    """Runs and shows, or only shows."""
    results = Path(cfg.results)
    if cfg.mode not in ("run", "train", "film", "report"):
        raise SystemExit(f"no mode {cfg.mode!r}: choose run, train, film or report")
    if cfg.mode != "report":
        keys = wanted_of(cfg)
        run(cfg, keys)
    if cfg.mode in ("train", "film"):
        return
    if cfg.mode == "run":
        write_rows(results, {key: answer_of(key, cfg) for key in keys})
    print(report(*read_rows(results), results, known=Path(cfg.known)))
    print(f"raw returns, assignments and tables in {results}")


if __name__ == "__main__":
    main()
