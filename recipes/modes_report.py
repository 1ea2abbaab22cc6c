"""Tables of recipes/ant_modes.py, from the raw files alone."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from ant_report import as_markdown
from ant_units import Key
from figure3_report import read_raw

from torchrl_tsallis.jobs import atomic_path
from torchrl_tsallis.modes import adjusted_rand_index

RETURNS = ("method", "trio", "task", "std", "seed", "component", "share", "recommended", "episode", "return")
ASSIGNED = ("trio", "task", "std", "seed", "agreement", "episode", "demonstrator", "mode",
            "membership")  # fmt: skip
#: Policies of all demonstrations that the modes' are compared with.
OTHERS = {"bc": "BC", "proposal": "proposal", "peak": "peak, tuned"}
Rows = list[dict[str, Any]]


def write_rows(folder: Path, answers: Mapping[Key, Mapping[str, Any]]) -> None:
    """Writes ``modes.csv`` and ``modes_assignments.csv``, atomically."""
    returns, assigned = [], []
    for key, answer in answers.items():
        cell = {"trio": key.trio, "task": key.task, "std": f"{key.std:g}", "seed": key.seed}
        modes = answer["mode"]
        for component, values in answer["returns"].items():
            share = sum(mode == int(component) for mode in modes) / len(modes)
            about = {"component": component, "share": f"{share:.4f}"}
            about["recommended"] = int(int(component) == answer["recommended"])
            rows = [{"episode": k, "return": f"{value:.3f}"} for k, value in enumerate(values)]
            returns += [{"method": "modes", **cell, **about, **row} for row in rows]
        per_episode = zip(modes, answer["expert"], answer["membership"], strict=True)
        for episode, (mode, who, share) in enumerate(per_episode):
            line = {"agreement": f"{answer['agreement']:.4f}", "episode": episode, "demonstrator": who, "mode": mode}
            assigned.append({**cell, **line, "membership": f"{share:.4f}"})
    for name, columns, rows in (("modes.csv", RETURNS, returns), ("modes_assignments.csv", ASSIGNED, assigned)):
        text = io.StringIO()
        writer = csv.DictWriter(text, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        with atomic_path(folder / name) as path:
            path.write_text(text.getvalue(), encoding="utf-8")


def read_rows(folder: Path) -> tuple[Rows, Rows]:
    """Reads what :func:`write_rows` wrote."""
    found = []
    for name in ("modes.csv", "modes_assignments.csv"):
        if not (folder / name).exists():
            raise SystemExit(f"there is no {folder / name}: run with mode=run first, or name the folder by results=...")
        with open(folder / name, newline="", encoding="utf-8") as file:
            found.append(list(csv.DictReader(file)))
    return found[0], found[1]


def by_cell(rows: Sequence[Mapping[str, Any]]) -> dict[tuple[str, str, float], dict[int, Rows]]:
    """Rows by cell and seed."""
    out: dict[tuple[str, str, float], dict[int, Rows]] = {}
    for row in rows:
        cell = out.setdefault((row["trio"], row["task"], float(row["std"])), {})
        cell.setdefault(int(row["seed"]), []).append(dict(row))
    return out


def medians(rows: Sequence[Mapping[str, Any]]) -> float:
    """Median of their returns; NaN where there is none."""
    return float(np.median([float(row["return"]) for row in rows])) if rows else float("nan")


def each(values: Sequence[float], digits: int = 0) -> str:
    """Median, and the value of each seed."""
    known = [value for value in values if not np.isnan(value)]
    listed = ", ".join("-" if np.isnan(value) else f"{value:.{digits}f}" for value in values)
    return f"{np.median(known):.{digits}f} ({listed})" if known else "-"


def cell_lines(seeds: Mapping[int, Rows], assigned: Mapping[int, Rows], others: Rows) -> dict[str, str]:
    """What the table says of one cell."""
    rand, experts_alone, count, best, chosen = [], [], [], [], []
    for seed, rows in seeds.items():
        mode, who = (torch.tensor([int(row[name]) for row in assigned[seed]]) for name in ("mode", "demonstrator"))
        expert = who < 3
        rand.append(adjusted_rand_index(mode, who))
        experts_alone.append(adjusted_rand_index(mode[expert], who[expert]))
        count.append(len({row["component"] for row in rows}))
        chosen.append(medians([row for row in rows if row["recommended"] == "1"]))
        best.append(max(medians([row for row in rows if row["component"] == name]) for name in
                        {row["component"] for row in rows}))  # fmt: skip
    line = {"policies": each(count), "Rand index": each(rand, 2), "of the experts": each(experts_alone, 2)}
    line |= {"recommended mode": each(chosen), "best mode": each(best)}
    for method, label in OTHERS.items():
        own = [[row for row in others if (row["method"], row["seed"]) == (method, seed)] for seed in seeds]
        line[label] = each([medians(rows) for rows in own])
    return line


def report(returns: Rows, assigned: Rows, folder: Path, *, known: Path) -> str:
    """Writes ``modes.md``; returns the text."""
    others = read_raw(known) if known.exists() else []
    found, table = by_cell(assigned), []
    for (trio, task, std), seeds in sorted(by_cell(returns).items()):
        own = [r for r in others if (r["trio"], r["task"], r["std"], r["scale"]) == (trio, task, std, 1.0)]
        line = {"trio": trio, "task": task, "std": f"{std:g}"}
        table.append(line | cell_lines(seeds, found[trio, task, std], own))
    text = (
        f"Median over seeds (value of each seed); returns are medians of a policy's episodes:\n\n{as_markdown(table)}"
    )
    with atomic_path(folder / "modes.md") as path:
        path.write_text(text + "\n", encoding="utf-8")
    return text
