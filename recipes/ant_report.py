"""Tables and pictures of recipes/ant_noise.py, from the files in its output folder."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load_file
from torch import Tensor

from torchrl_tsallis.evaluation import (
    auroc,
    auroc_bars,
    bootstrap_interval,
    iqm,
    median,
    rating_histogram,
    return_by_method,
    schedule,
)
from torchrl_tsallis.jobs import atomic_path
from torchrl_tsallis.trainers import make_logger

COLUMNS = ("method", "task", "seed", "episode", "return")


def kinds_of(data: Any) -> dict[str, Tensor]:
    """Ground truth of demonstrations: masks ``[N]`` of the clean, noisy and amateur samples that there are."""
    noisy, amateur = data["info", "is_noise"], data["info", "is_amateur"]
    masks = {"clean": ~(noisy | amateur), "noisy": noisy, "amateur": amateur & ~noisy}
    return {kind: mask for kind, mask in masks.items() if mask.any()}


def save_returns(path: str | Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes raw returns as CSV, atomically."""
    with atomic_path(path) as temporary, open(temporary, "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, extrasaction="ignore")
        writer.writeheader()
        writer.writerows({**row, "return": f"{row['return']:.3f}"} for row in rows)


def read_returns(path: str | Path) -> list[dict[str, Any]]:
    """Reads what :func:`save_returns` wrote."""
    with open(path, newline="") as file:
        return [{**row, "seed": int(row["seed"]), "return": float(row["return"])} for row in csv.DictReader(file)]


def by_method(rows: Sequence[Mapping[str, Any]], task: str) -> dict[str, np.ndarray]:
    """Returns of a task, ``[S, E]`` for each method."""
    nested: dict[str, dict[int, list[float]]] = {}
    for row in rows:
        if row["task"] == task:
            nested.setdefault(row["method"], {}).setdefault(row["seed"], []).append(row["return"])
    return {method: np.array([seeds[key] for key in sorted(seeds)]) for method, seeds in nested.items()}


def detection(folder: Path) -> dict[str, float]:
    """AUROC of a training's rating, for each kind of bad sample against the clean ones."""
    file = load_file(folder / "ratings.safetensors")
    clean = file["rating"][file["clean"]]
    return {kind: auroc(clean, file["rating"][file[kind]]) for kind in ("noisy", "amateur") if kind in file}


def summarise(rows: Sequence[Mapping[str, Any]], output: Path) -> list[dict[str, str]]:
    """One row of text for each task and method: median with its interval, IQM, AUROC of the rating."""
    table = []
    for task in dict.fromkeys(row["task"] for row in rows):
        for method, returns in by_method(rows, task).items():
            interval = bootstrap_interval(returns, median)
            folders = sorted((output / task).glob(f"seed_*/{method}"))
            scores = [detection(folder) for folder in folders if (folder / "ratings.safetensors").exists()]
            line = {"task": task, "method": method, "median": f"{interval['value']:.0f}"}
            line["95 % interval"] = f"{interval['low']:.0f} to {interval['high']:.0f} ({interval['unit']}s)"
            line |= {"IQM": f"{iqm(returns):.0f}", "episodes": f"{returns.shape[0]} x {returns.shape[1]}"}
            line["median of each seed"] = ", ".join(f"{median(seed):.0f}" for seed in returns)
            for kind in ("noisy", "amateur"):
                found = [score[kind] for score in scores if kind in score]
                line[f"AUROC {kind}"] = f"{np.mean(found):.3f}" if found else "-"
            table.append(line)
    return table


def as_markdown(table: Sequence[Mapping[str, str]]) -> str:
    """The table as aligned Markdown."""
    columns = list(table[0])
    width = {c: max(len(c), *(len(row[c]) for row in table)) for c in columns}
    lines = [[c.ljust(width[c]) for c in columns], ["-" * width[c] for c in columns]]
    lines += [[row[c].ljust(width[c]) for c in columns] for row in table]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def read_scalars(folder: Path, name: str) -> dict[int, float]:
    """A logged quantity by step; a step that was logged again after a resumption counts once."""
    path = folder / "scalars" / f"{name}.csv"
    if not path.exists():
        return {}
    with open(path, newline="") as file:
        return {int(step): float(value) for step, value in csv.reader(file)}


def save_plots(rows: Sequence[Mapping[str, Any]], output: Path, pictures: Path) -> list[Path]:
    """Pictures of each task: returns over all seeds; ratings, schedules and detection of the first seed."""
    paths = []
    for task in dict.fromkeys(row["task"] for row in rows):
        first = min(row["seed"] for row in rows if row["task"] == task)
        returns = by_method(rows, task)
        folders = {method: output / task / f"seed_{first}" / method for method in returns}
        paths.append(return_by_method(returns, pictures / f"returns_{task}.png", title=f"Ant, task '{task}'"))
        curves: dict[str, Any] = {}
        for method, folder in folders.items():
            q, gamma = (read_scalars(folder, name) for name in ("q", "gamma_mix"))
            if q and gamma:
                curves[method] = {"step": list(q), "q": list(q.values()), "gamma": [gamma[step] for step in q]}
        if curves:
            paths.append(schedule(curves, pictures / f"schedule_{task}.png", title=f"task '{task}', seed {first}"))
        scores = {method: detection(folder) for method, folder in folders.items()}
        bars = {f"{method}\n{kind}": value for method, score in scores.items() for kind, value in score.items()}
        if bars:
            paths.append(auroc_bars(bars, pictures / f"auroc_{task}.png", title=f"task '{task}', seed {first}"))
        for method, folder in folders.items():
            file = load_file(folder / "ratings.safetensors")
            ratings = {kind: file["rating"][file[kind]] for kind in ("clean", "noisy", "amateur") if kind in file}
            if np.ptp(file["rating"]) > 0:  # plain BC rates every sample 1
                name = pictures / f"rating_{task}_{method}.png"
                paths.append(rating_histogram(ratings, name, title=f"{method}, task '{task}', seed {first}"))
    return paths


def publish(
    table: Sequence[Mapping[str, str]], draw: Callable[[], list[Path]], output: Path, pictures: Path, kind: str
) -> str:
    """Writes ``table.md`` and what ``draw`` makes, logs them as a run named summary, and returns the table's text."""
    text = as_markdown(table)
    with atomic_path(pictures / "table.md") as path:
        path.write_text(text, encoding="utf-8")
    logger = make_logger(kind, output, "summary", group="summary")
    logger.log_table("results", table)
    for picture in draw():
        logger.log_picture(picture.stem, picture)
    logger.shutdown()
    return text


def report(rows: Sequence[Mapping[str, Any]], output: Path, pictures: Path, kind: str) -> str:
    """Publishes the table and the pictures of all tasks; returns the table's text."""
    return publish(summarise(rows, output), lambda: save_plots(rows, output, pictures), output, pictures, kind)
