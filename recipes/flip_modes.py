"""Whose page flips are these? Modes among demonstrations of two operators, who differ in speed and height.

Records both operators, finds modes without labels, and compares them with who it was; may be killed and started again::

    python recipes/flip_modes.py
    python recipes/flip_modes.py mode=report results=docs/results
"""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import torch
from common import keep_settings
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict

from torchrl_tsallis.data import save_demonstrations
from torchrl_tsallis.data.flip_demonstrations import record_flips
from torchrl_tsallis.data.teleoperation import draw_style
from torchrl_tsallis.envs import make_page_flip
from torchrl_tsallis.jobs import atomic_path, run_jobs, tick
from torchrl_tsallis.modes import adjusted_rand_index
from torchrl_tsallis.run import modes

COLUMNS = ("pair", "seed", "told", "evidence", "trajectory", "operator", "tremor", "wander", "pages", "mode",
           "membership", "recommended")  # fmt: skip


def record(operators: Any, trajectories: int, seed: int, keep: bool) -> tuple[TensorDict, list[tuple[str, str, int]]]:
    """Both operators in turns, ``[2 n 500]``, with who it was under ``operator``; tremor, wander and pages of each.

    Args:
        operators: habits that are set, by operator.
        trajectories: of each operator.
        seed: of what is drawn.
        keep: whether an operator's other habits are drawn once, or anew for each trajectory.
    """
    parts, habits = [], []
    own = [draw_style(np.random.default_rng([seed, who, 2])) for who in range(len(operators))]
    for episode in range(trajectories * len(operators)):
        who = episode % len(operators)
        number = 100_000 * (seed + 1) + episode
        drawn = own[who] if keep else draw_style(np.random.default_rng([number, 1]))
        style = replace(drawn, **list(operators.values())[who])
        data, facts = record_flips(make_page_flip, seed=number, style=style)
        rows = data.select("observation", "action", "is_init", "next")
        parts.append(
            rows.set("episode", torch.full((len(rows),), episode)).set("operator", torch.full((len(rows),), who))
        )
        habits.append((f"{style.tremor:.6f}", f"{style.wander:.6f}", facts["flips"]))
    return torch.cat(parts), habits


def search(job: tuple[str, int], cfg: DictConfig) -> None:
    """Records, finds the modes and writes the rows of one pair and seed, in a process of its own."""
    pair, seed = job
    file = Path(cfg.output) / f"{pair}_{seed}.csv"
    if not file.exists():
        operators = cfg.pairs[pair].operators
        data, habits = record(operators, cfg.trajectories, seed, cfg.pairs[pair].keep)
        path = Path(cfg.output) / f"{pair}_{seed}.safetensors"
        save_demonstrations(path, data, {"pages": [pages for *_, pages in habits]})
        names, text = list(operators), io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        for told in ("", len(operators)):  # how many there are
            folder = Path(cfg.output) / (f"{pair}_{seed}_told" if told else f"{pair}_{seed}")
            asked = {**cfg.search, "components": told} if told else cfg.search
            found = modes(path, folder, labels="operator", seed=seed, progress=False, overwrite=True, **asked)
            known = [line.rpartition(",")[2] for line in (folder / "labels.csv").read_text().splitlines()[1:]]
            for k, (who, mode) in enumerate(zip(known, found.mode.tolist(), strict=True)):
                best = int(mode == found.summary["recommended"])
                facts = [f"{found.summary['evidence']:.4f}", k, names[int(who)], *habits[k], mode]
                writer.writerow([pair, seed, told, *facts, f"{found.membership[k]:.4f}", best])
        with atomic_path(file) as temporary:
            temporary.write_text(text.getvalue(), encoding="utf-8")
    tick()


def explained(values: Any, mode: np.ndarray) -> float:
    """Share of a habit's variance that modes explain, adjusted for their number: 0 is chance."""
    value, numbers = np.asarray(values), np.unique(mode)
    within = sum(((value[mode == k] - value[mode == k].mean()) ** 2).sum() for k in numbers)
    total = ((value - value.mean()) ** 2).sum()
    return float(1 - within / total * (len(value) - 1) / max(1, len(value) - len(numbers)))


def report(results: Path) -> str:
    """The table of a raw file, a line a seed."""
    with open(results / "flip_modes.csv", newline="", encoding="utf-8") as file:
        rows: list[dict[str, Any]] = list(csv.DictReader(file))
    names_of = ("operators", "seed", "told how many", "evidence", "modes", "Rand index", "tremor", "wander")
    lines = [f"| {' | '.join(names_of)} |", f"|{'---|' * len(names_of)}"]
    for case in dict.fromkeys((row["pair"], row["seed"], row["told"]) for row in rows):
        own = [row for row in rows if (row["pair"], row["seed"], row["told"]) == case]
        names, mode = sorted({row["operator"] for row in own}), torch.tensor([int(row["mode"]) for row in own])
        who = torch.tensor([names.index(row["operator"]) for row in own])
        groups = []
        for k in mode.unique().tolist():
            counts = {name: int((who[mode == k] == i).sum()) for i, name in enumerate(names)}
            groups.append(", ".join(f"{count} {name}" for name, count in counts.items() if count))
        line = [*case, own[0]["evidence"], " / ".join(groups), f"{adjusted_rand_index(mode, who):.2f}"]
        line += [f"{explained([float(row[name]) for row in own], mode.numpy()):.2f}" for name in ("tremor", "wander")]
        lines.append(f"| {' | '.join(line)} |")
    text = "\n".join(lines)
    with atomic_path(results / "flip_modes.md") as path:
        path.write_text(text + "\n", encoding="utf-8")
    return text


@hydra.main(version_base="1.3", config_path=".", config_name="flip_modes")
def main(cfg: DictConfig) -> None:
    """Runs and shows, or only shows."""
    if cfg.mode not in ("run", "report"):
        raise SystemExit(f"no mode {cfg.mode!r}: choose run or report")
    results = Path(cfg.results)
    if cfg.mode == "run":
        cfg.output = str(Path(cfg.output).absolute())
        settings: Any = OmegaConf.to_container(cfg, resolve=True)
        keep_settings(Path(cfg.output) / "settings.json", settings, ("pairs", "trajectories", "search"))
        jobs = list(product(cfg.pairs, cfg.seeds))
        bar = {"desc": "finding modes", "unit": "seed", "progress": cfg.progress, "workers": cfg.workers}
        run_jobs(partial(search, cfg=cfg), jobs, total=len(jobs), **bar)
        parts = [(Path(cfg.output) / f"{pair}_{seed}.csv").read_text(encoding="utf-8") for pair, seed in jobs]
        with atomic_path(results / "flip_modes.csv") as path:
            path.write_text(",".join(COLUMNS) + "\n" + "".join(parts), encoding="utf-8")
    print(report(results))


if __name__ == "__main__":
    main()
