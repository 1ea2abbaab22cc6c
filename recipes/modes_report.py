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
from modes_picture import draw

from torchrl_tsallis.jobs import atomic_path
from torchrl_tsallis.modes import adjusted_rand_index

RETURNS = ("method", "trio", "task", "std", "seed", "component", "share", "recommended", "episode", "return")
ASSIGNED = ("method", "trio", "task", "std", "seed", "evidence", "episode", "demonstrator", "mode",
            "membership")  # fmt: skip
#: What modes were found by.
METHODS = {"modes": "distributions", "mixtures": "policies"}
FILES = {"modes.csv": RETURNS, "modes_assignments.csv": ASSIGNED}
#: Policies of all demonstrations that the modes' are compared with.
OTHERS = {"bc": "BC", "proposal": "proposal", "peak": "peak, tuned"}
Rows = list[dict[str, Any]]


def write_rows(folder: Path, answers: Mapping[Key, Mapping[str, Any]]) -> None:
    """Writes ``modes.csv`` and ``modes_assignments.csv``, atomically; rows of another method stay."""
    returns, assigned = [], []
    for key, answer in answers.items():
        cell = {"method": key.method, "trio": key.trio, "task": key.task, "std": f"{key.std:g}", "seed": key.seed}
        modes = answer["mode"]
        for component, values in answer["returns"].items():
            share = sum(mode == int(component) for mode in modes) / len(modes)
            about = {"component": component, "share": f"{share:.4f}"}
            about["recommended"] = int(int(component) == answer["recommended"])
            returns += [{**cell, **about, "episode": k, "return": f"{value:.3f}"} for k, value in enumerate(values)]
        per_episode = zip(modes, answer["expert"], answer["membership"], strict=True)
        for episode, (mode, who, share) in enumerate(per_episode):
            line = {"evidence": f"{answer['evidence']:.4f}", "episode": episode, "demonstrator": who, "mode": mode}
            assigned.append({**cell, **line, "membership": f"{share:.4f}"})
    methods = {key.method for key in answers}
    old = read_rows(folder) if all((folder / name).exists() for name in FILES) else ([], [])
    for name, rows, before in zip(FILES, (returns, assigned), old, strict=True):
        text = io.StringIO()
        writer = csv.DictWriter(text, FILES[name], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows + [row for row in before if row["method"] not in methods])
        with atomic_path(folder / name) as path:
            path.write_text(text.getvalue(), encoding="utf-8")


def read_rows(folder: Path) -> tuple[Rows, Rows]:
    """Reads what :func:`write_rows` wrote."""
    found = []
    for name in FILES:
        if not (folder / name).exists():
            raise SystemExit(f"there is no {folder / name}: run with mode=run first, or name the folder by results=...")
        with open(folder / name, newline="", encoding="utf-8") as file:
            found.append(list(csv.DictReader(file)))
    return found[0], found[1]


def by_cell(rows: Sequence[Mapping[str, Any]]) -> dict[tuple[str, str, float, str], dict[int, Rows]]:
    """Rows by cell and seed; a cell is trio, task, noise and method."""
    out: dict[tuple[str, str, float, str], dict[int, Rows]] = {}
    for row in rows:
        cell = out.setdefault((row["trio"], row["task"], float(row["std"]), row["method"]), {})
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


def values_of(seeds: Mapping[int, Rows], others: Rows) -> dict[str, list[float]]:
    """Median return of each seed: of the recommended mode's policy, the best mode's, and policies of all episodes."""
    out: dict[str, list[float]] = {"recommended mode": [], "best mode": []}
    for rows in seeds.values():
        by_mode = {
            name: [row for row in rows if row["component"] == name] for name in {row["component"] for row in rows}
        }
        out["recommended mode"].append(medians([row for row in rows if row["recommended"] == "1"]))
        out["best mode"].append(max(map(medians, by_mode.values())))
    for method, label in OTHERS.items():
        own = [[row for row in others if (row["method"], row["seed"]) == (method, seed)] for seed in seeds]
        out[label] = [medians(rows) for rows in own]
    return out


def agreement_of(assigned: Mapping[int, Rows]) -> dict[str, str]:
    """How the modes of each seed go with who demonstrated: of all episodes, and of the experts' alone."""
    all_of, experts, count = [], [], []
    for rows in assigned.values():
        mode, who = (torch.tensor([int(row[name]) for row in rows]) for name in ("mode", "demonstrator"))
        all_of.append(adjusted_rand_index(mode, who))
        experts.append(adjusted_rand_index(mode[who < 3], who[who < 3]))
        count.append(int((mode.bincount() > 2).sum()))
    return {"modes of 3 or more": each(count), "Rand index": each(all_of, 2), "of the experts": each(experts, 2)}


def report(returns: Rows, assigned: Rows, folder: Path, *, known: Path) -> str:
    """Writes ``modes.md`` and ``modes.png``; returns the text."""
    others = read_raw(known) if known.exists() else []
    found, table, cells = by_cell(assigned), [], {}
    walked = by_cell(returns)
    for trio, task, std, method in sorted(walked, key=lambda cell: (*cell[:3], list(METHODS).index(cell[3]))):
        seeds = walked[trio, task, std, method]
        own = [r for r in others if (r["trio"], r["task"], r["std"], r["scale"]) == (trio, task, std, 1.0)]
        values = values_of(seeds, own)
        shown = cells.setdefault((trio, task, std), values if method == "modes" else {})
        if method == "mixtures":
            shown["recommended, by policies"] = values["recommended mode"]
            values = {name: value for name, value in values.items() if name not in OTHERS.values()}
        line = {"trio": trio, "task": task, "std": f"{std:g}", "by": METHODS[method]}
        line |= agreement_of(found[trio, task, std, method])
        table.append(line | {name: each(numbers) for name, numbers in values.items()})
    table = [{name: line.get(name, "") for name in table[0]} for line in table]
    text = (
        f"Median over seeds (value of each seed); returns are medians of a policy's episodes:\n\n{as_markdown(table)}"
    )
    with atomic_path(folder / "modes.md") as path:
        path.write_text(text + "\n", encoding="utf-8")
    draw(cells, folder / "modes.png")
    return text
