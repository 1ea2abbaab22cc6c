"""Tables of recipes/curation.py, from the raw files alone."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from ant_report import as_markdown
from figure3_report import read_raw
from regimes_report import label_of

from torchrl_tsallis.evaluation import bootstrap_interval, median
from torchrl_tsallis.jobs import atomic_path

COLUMNS = ("data", "std", "seed", "score", "label", "level", "auroc")


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes the qualities as CSV, atomically."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows({**row, "std": f"{row['std']:g}", "auroc": f"{row['auroc']:.4f}"} for row in rows)
    with atomic_path(path) as temporary:
        temporary.write_text(text.getvalue(), encoding="utf-8")


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Reads what :func:`write_rows` wrote."""
    if not path.exists():
        raise SystemExit(f"there is no {path}: run with mode=run first, or name the folder by results=...")
    with open(path, newline="", encoding="utf-8") as file:
        return [
            {**row, "std": float(row["std"]), "seed": int(row["seed"]), "auroc": float(row["auroc"])}
            for row in csv.DictReader(file)
        ]


def quality_tables(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """One table a kind of fault and level: a line a score, a column a noise; mean over seeds, with its range."""
    texts = []
    kinds = dict.fromkeys((row["data"], row["label"], row["level"]) for row in rows)
    for data, label, level in kinds:
        own = [row for row in rows if (row["data"], row["label"], row["level"]) == (data, label, level)]
        stds = sorted({row["std"] for row in own})
        table = []
        for score in dict.fromkeys(row["score"] for row in own):
            line = {"score": score}
            for std in stds:
                values = [row["auroc"] for row in own if row["score"] == score and row["std"] == std]
                text = f"{np.mean(values):.2f} ({min(values):.2f} to {max(values):.2f})"
                line[f"noise {std:g}" if std else "AUROC"] = text
            table.append(line)
        texts.append(f"`{data}`, {label}, {level}:\n\n{as_markdown(table)}")
    return texts


def returns_table(curated: Sequence[Mapping[str, Any]], whole: Sequence[Mapping[str, Any]]) -> str:
    """Returns of policies of all demonstrations beside those without what was dropped, on the same seeds."""
    keys = {(row["task"].partition("@")[0], row["std"], row["method"]) for row in curated}
    seeds = {row["seed"] for row in curated}
    table = []
    for task, std, method in sorted(keys):
        line = {"task": task, "noise": f"{std:g}", "method": label_of(method)}
        base = [r for r in whole if (r["trio"], r["scale"], r["seed"] in seeds) == ("own", 1.0, True)]
        for rule in ("", "surprise", "return"):
            name, rows = f"{task}@{rule}" if rule else task, curated if rule else base
            by_seed: dict[int, list[float]] = {}
            for row in rows:
                if (row["task"], row["std"], row["method"]) == (name, std, method):
                    by_seed.setdefault(row["seed"], []).append(row["return"])
            text = "-"
            if by_seed:
                result = bootstrap_interval(np.array([by_seed[seed] for seed in sorted(by_seed)]), median)
                text = f"{result['value']:.0f} ({result['low']:.0f} to {result['high']:.0f})"
            line[f"without the worst by {rule}" if rule else "all demonstrations"] = text
        table.append(line)
    return as_markdown(table)


def report(rows: Sequence[Mapping[str, Any]], folder: Path, *, whole: Path) -> str:
    """Writes ``curation.md``; returns the text."""
    parts = ["AUROC, mean over seeds (least to largest); 0.5 is chance:", *quality_tables(rows)]
    returns = folder / "curation_returns.csv"
    if returns.exists():
        parts.append("Median returns, with 95 % bootstrap intervals over seeds:")
        parts.append(returns_table(read_raw(returns), read_raw(whole) if whole.exists() else []))
    text = "\n\n".join(parts) + "\n"
    with atomic_path(folder / "curation.md") as path:
        path.write_text(text, encoding="utf-8")
    return text
