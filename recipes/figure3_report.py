"""Table and pictures of recipes/ant_figure3.py, from the raw returns alone."""

from __future__ import annotations

import gzip
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from ant_report import as_markdown, by_method
from ant_units import as_csv, key_of, parse

from torchrl_tsallis.evaluation import bootstrap_interval, improvement_interval, iqm, median, returns_grid
from torchrl_tsallis.jobs import atomic_path

LABELS = {
    "bc": "BC (q = 1)",
    "adaptive_q": "tuned q, gamma = 0",
    "adaptive_gamma": "adaptive gamma, q = 0.8",
    "proposal": "proposal",
}
#: Columns of the published file.
FIGURE3 = ("method", "task", "std", "seed", "episode", "return")
Scores = dict[str, dict[str, np.ndarray]]  # task -> method -> [S, E]


def save_raw(path: str | Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes raw returns as gzipped CSV, atomically; equal rows give equal files."""
    text = io.BytesIO()
    with gzip.GzipFile(fileobj=text, mode="wb", filename="", mtime=0) as file:
        file.write(as_csv(rows, columns=FIGURE3).encode())
    with atomic_path(path) as temporary:
        temporary.write_bytes(text.getvalue())


def read_raw(path: str | Path) -> list[dict[str, Any]]:
    """Reads what :func:`save_raw` wrote, or the growing table itself."""
    if not Path(path).exists():
        raise SystemExit(f"there is no {path}: run with mode=run first, or name the file by results=...")
    content = Path(path).read_bytes()
    return parse((gzip.decompress(content) if str(path).endswith(".gz") else content).decode())


def label_of(method: str) -> str:
    """A method's name in the table and the figure."""
    return LABELS.get(method, method.replace("q_bc_", "q = "))


def scores_of(rows: Sequence[Mapping[str, Any]]) -> Scores:
    """Returns by task and method, ``[S, E]``; of seeds that are being evaluated, only complete ones."""
    episodes = 1 + max(row["episode"] for row in rows)
    counts = Counter(map(key_of, rows))
    whole = [row for row in rows if counts[key_of(row)] == episodes]
    return {task: by_method(whole, task) for task in dict.fromkeys(row["task"] for row in whole)}


def with_interval(result: Mapping[str, Any], digits: int = 0) -> str:
    """An estimate and its interval."""
    value, low, high = (f"{result[name]:.{digits}f}" for name in ("value", "low", "high"))
    return f"{value} ({low} to {high})"


def learned(returns: np.ndarray, level: float | None) -> str:
    """How many policies, of returns ``[*, E]``, have a median return of at least ``level``."""
    if level is None:
        return "-"
    good = np.median(returns, axis=-1) >= level
    return f"{good.sum()}/{good.size}"


def line_of(
    task: str, method: str, returns: np.ndarray, reference: np.ndarray | None, level: float | None
) -> dict[str, str]:
    """A row of the table, of returns ``[S, E]`` or ``[T, S, E]``, those of BC, and the level that means success."""
    line = {"task": task, "method": label_of(method), "seeds x episodes": f"{returns.shape[-2]} x {returns.shape[-1]}"}
    line["median"] = with_interval(bootstrap_interval(returns, median))
    line["IQM"] = with_interval(bootstrap_interval(returns, iqm))
    line["learned"] = learned(returns, level)
    line["better than BC"] = "-"
    if reference is not None and method != "bc" and returns.shape[-2] > 1:
        result = improvement_interval(np.median(returns, axis=-1), np.median(reference, axis=-1))
        line["better than BC"] = with_interval(result, 2)
    return line


def summarise(scores: Scores) -> list[dict[str, str]]:
    """The table: every task, and all of them together where the seeds are complete.

    A policy has learned if its median return is at least half of BC's on the clean task.
    """
    best = scores.get("clean", {}).get("bc")
    level = None if best is None else 0.5 * median(best)
    table = [
        line_of(task, method, returns, methods.get("bc"), level)
        for task, methods in scores.items()
        for method, returns in methods.items()
    ]
    together = {
        method: np.stack([methods[method] for methods in scores.values()])
        for method in next(iter(scores.values()))
        if len({methods[method].shape if method in methods else None for methods in scores.values()}) == 1
    }
    if len(scores) > 1:
        table += [line_of("all", method, returns, together.get("bc"), level) for method, returns in together.items()]
    return table


def report(rows: Sequence[Mapping[str, Any]], pictures: Path) -> str:
    """Writes ``figure3.md``, and ``figure3_std<std>.png`` and ``.svg`` of each standard deviation; returns the text."""
    parts = []
    for std in sorted({row["std"] for row in rows}):
        scores = scores_of([row for row in rows if row["std"] == std])
        parts.append(f"Standard deviation of the experts' actions {std:g}:\n\n{as_markdown(summarise(scores))}")
        panels = {task: {label_of(m): values for m, values in methods.items()} for task, methods in scores.items()}
        paths = [pictures / f"figure3_std{std:g}.{kind}" for kind in ("png", "svg")]
        returns_grid(panels, paths, title=f"Imitation of the Ant, experts' standard deviation {std:g}")
    text = "\n".join(parts)
    with atomic_path(pictures / "figure3.md") as path:
        path.write_text(text, encoding="utf-8")
    return text
