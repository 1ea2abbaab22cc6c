"""Table and pictures of recipes/page_flip.py, from the files in its output folder."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from ant_report import publish, read_scalars
from safetensors.numpy import load_file
from torch import Tensor

from torchrl_tsallis.evaluation import auroc, bootstrap_interval, error_curves, flip_trajectories, ratings_over_time
from torchrl_tsallis.evaluation.plots import schedule
from torchrl_tsallis.jobs import atomic_path

COLUMNS = ("method", "seed", "trial", "flips", "events", "singles", "multiples", "run", "success")


def faults_of(data: Any) -> dict[str, Tensor]:
    """The labelled faults of demonstrations, masks ``[N]``; training never sees them."""
    return {name: value for name, value in data["info"].items() if value.dtype == torch.bool}


def save_rows(path: str | Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes one row a trial as CSV, atomically."""
    with atomic_path(path) as temporary, open(temporary, "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)


def read_rows(path: str | Path) -> list[dict[str, Any]]:
    """Reads what :func:`save_rows` wrote."""
    with open(path, newline="") as file:
        return [{k: v if k == "method" else int(v) for k, v in row.items()} for row in csv.DictReader(file)]


def by_seed(rows: Sequence[Mapping[str, Any]], method: str, column: str) -> np.ndarray:
    """A method's counts, ``[S, trials]``."""
    nested: dict[int, list[float]] = {}
    for row in rows:
        if row["method"] == method:
            nested.setdefault(row["seed"], []).append(row[column])
    return np.array([nested[seed] for seed in sorted(nested)])


def errors_of(output: Path, method: str) -> tuple[list[int], np.ndarray]:
    """Steps ``[E]``, and the errors on the validation data at them, ``[S, E]`` in N^2."""
    curves = [read_scalars(folder, "eval/mse") for folder in sorted(output.glob(f"seed_*/{method}"))]
    steps = sorted(set.intersection(*(set(curve) for curve in curves))) if curves else []
    return steps, np.array([[curve[step] for step in steps] for curve in curves])


def detection(folder: Path) -> float | None:
    """AUROC of a training's rating: the steps without a labelled fault against those with one, where there are any."""
    file = load_file(folder / "ratings.safetensors")
    fault = file["is_noise"]
    return auroc(file["rating"][~fault], file["rating"][fault]) if fault.any() and not fault.all() else None


def summarise(rows: Sequence[Mapping[str, Any]], output: Path) -> list[dict[str, str]]:
    """Table I: one row of text a method; the intervals are over seeds."""
    table = []
    for method in dict.fromkeys(row["method"] for row in rows):
        success, flips = by_seed(rows, method, "success"), by_seed(rows, method, "flips")
        rate = bootstrap_interval(success, lambda x: float(x.mean()))
        line = {"method": method, "success of continuous flips": f"{int(success.sum())}/{success.size}"}
        line["rate, 95 % interval"] = (
            f"{rate['value']:.2f}, {rate['low']:.2f} to {rate['high']:.2f} ({rate['n']} {rate['unit']}s)"
        )
        line["success of each seed"] = ", ".join(f"{int(seed.sum())}/{seed.size}" for seed in success)
        line["flips"] = f"{int(flips.sum())}"
        line["single, multiple"] = ", ".join(f"{by_seed(rows, method, c).sum():.0f}" for c in ("singles", "multiples"))
        steps, errors = errors_of(output, method)
        line["final MSE [N^2]"] = f"{np.median(errors[:, -1]):.4g}" if steps else "-"
        folders = [f for f in sorted(output.glob(f"seed_*/{method}")) if (f / "ratings.safetensors").exists()]
        scores = [score for score in map(detection, folders) if score is not None]
        line["AUROC fault"] = f"{np.mean(scores):.3f}" if scores else "-"
        table.append(line)
    return table


def typical_trial(rows: Sequence[Mapping[str, Any]], method: str, seed: int) -> int:
    """The trial whose number of flips is nearest to the median, the first of them."""
    counts = {row["trial"]: row["flips"] for row in rows if row["method"] == method and row["seed"] == seed}
    middle = float(np.median(list(counts.values())))
    return min(counts, key=lambda trial: (abs(counts[trial] - middle), trial))


def save_plots(rows: Sequence[Mapping[str, Any]], output: Path, pictures: Path, steps: int, epoch: int) -> list[Path]:
    """Figures 5 and 6, ratings along the first training demonstration, and q and gamma of the first seed.

    Args:
        rows: of all trials.
        output: folder of the trainings.
        pictures: folder of the pictures.
        steps: pairs a trajectory.
        epoch: optimizer's steps an epoch.

    Returns:
        The pictures.
    """
    methods = list(dict.fromkeys(row["method"] for row in rows))
    first = min(row["seed"] for row in rows)
    folders = {method: output / f"seed_{first}" / method for method in methods}
    errors = {method: errors_of(output, method) for method in methods}
    curves = {method: (np.array(x) / epoch, y) for method, (x, y) in errors.items() if x}
    paths = [error_curves(curves, pictures / "mse.png", title="error on held-out trajectories")] if curves else []
    trials, ratings, schedules, faults = {}, {}, {}, {}
    for method, folder in folders.items():
        number = typical_trial(rows, method, first)
        with np.load(folder / "trials.npz") as file:
            trials[f"{method}, trial {number}"] = (file[f"positions_{number}"], file[f"forces_{number}"])
        found = load_file(folder / "ratings.safetensors")
        ratings[method] = found.pop("rating")[:steps]
        faults = {name: mask[:steps] for name, mask in found.items() if name != "is_noise"}
        q, gamma = (read_scalars(folder, name) for name in ("q", "gamma_mix"))
        if q and gamma:
            schedules[method] = {"step": list(q), "q": list(q.values()), "gamma": [gamma[step] for step in q]}
    paths.append(flip_trajectories(trials, pictures / "trajectories.png", title=f"seed {first}"))
    paths.append(ratings_over_time(ratings, pictures / "ratings.png", faults=faults, title="one demonstration"))
    if schedules:
        paths.append(schedule(schedules, pictures / "schedule.png", title=f"page flipping, seed {first}"))
    return paths


def report(
    rows: Sequence[Mapping[str, Any]], output: Path, pictures: Path, kind: str, *, steps: int, epoch: int
) -> str:
    """Publishes the table, the pictures, and each method's video beside them; returns the table's text."""
    pictures.mkdir(parents=True, exist_ok=True)
    for video in sorted(output.glob("seed_*/*/rollout.gif")):
        shutil.copyfile(video, pictures / f"{video.parent.name}.gif")
    return publish(
        summarise(rows, output), lambda: save_plots(rows, output, pictures, steps, epoch), output, pictures, kind
    )
