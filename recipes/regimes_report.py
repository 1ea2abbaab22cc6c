"""Table, claims and map of recipes/ant_regimes.py, from the raw returns alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from ant_report import as_markdown
from ant_units import Key, as_csv, key_of

from torchrl_tsallis.evaluation import bootstrap_interval, median, returns_by_level
from torchrl_tsallis.jobs import atomic_path

#: In the order of the table and the map.
ORDER = (
    "bc",
    "q_bc_0.95",
    "q_bc_0.9",
    "q_bc_0.8",
    "q_bc_0.7",
    "q_bc_0.6",
    "proposal",
    "adaptive_gamma",
    "peak",
    "peak_fixed",
    "beta_only",
)
#: Drawn in the map.
MAP = ("bc", "q_bc_0.95", "peak", "q_bc_0.8", "proposal", "adaptive_gamma", "q_bc_0.9", "peak_fixed")
LABELS = {
    "bc": "BC",
    "proposal": "proposal",
    "adaptive_gamma": "adaptive gamma, q = 0.8",
    "peak": "peak, tuned",
    "peak_fixed": "peak, u = 0.1",
    "beta_only": "BC, beta = 0.5",
}
Cell = tuple[str, str, float, float]  # trio, task, std, scale
Scores = dict[Cell, dict[str, np.ndarray]]  # cell -> method -> [S, E]


def save_raw(path: str | Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes raw returns as CSV, atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(as_csv(rows), encoding="utf-8")


def label_of(method: str) -> str:
    """A method's name in the table and the map."""
    return LABELS.get(method, method.replace("q_bc_", "q = "))


def ordered(methods: Mapping[str, Any]) -> list[str]:
    """Methods in the table's order, unknown ones last."""
    return sorted(methods, key=lambda method: ORDER.index(method) if method in ORDER else len(ORDER))


def scores_of(rows: Sequence[Mapping[str, Any]]) -> Scores:
    """Returns ``[S, E]`` by cell and method; of policies that are being evaluated, only complete ones."""
    episodes = 1 + max(row["episode"] for row in rows)
    counts = Counter(map(key_of, rows))
    nested: dict[Cell, dict[str, dict[int, list[float]]]] = {}
    for row in rows:
        key: Key = key_of(row)
        if counts[key] == episodes:
            cell = nested.setdefault((key.trio, key.task, key.std, key.scale), {})
            cell.setdefault(key.method, {}).setdefault(key.seed, []).append(row["return"])
    return {
        cell: {method: np.array([methods[method][s] for s in sorted(methods[method])]) for method in ordered(methods)}
        for cell, methods in nested.items()
    }


def table_of(scores: Scores) -> list[dict[str, str]]:
    """One row a cell and method: the median with its interval over seeds, and how many policies learned.

    A policy has learned if its median return is at least half of BC's on the clean task of the same trio and noise.
    """
    table = []
    for (trio, task, std, scale), methods in sorted(scores.items()):
        clean = scores.get((trio, "clean", std, 1.0), {}).get("bc")
        for method, returns in methods.items():
            result = bootstrap_interval(returns, median)
            line = {"trio": trio, "task": task, "std": f"{std:g}", "scale": f"{scale:g}", "method": label_of(method)}
            line["seeds x episodes"] = f"{returns.shape[0]} x {returns.shape[1]}"
            line["median"] = f"{result['value']:.0f} ({result['low']:.0f} to {result['high']:.0f})"
            line["median of each seed"] = ", ".join(f"{np.median(seed):.0f}" for seed in returns)
            line["learned"] = "-"
            if clean is not None:
                line["learned"] = f"{(np.median(returns, axis=1) >= 0.5 * median(clean)).sum()}/{len(returns)}"
            table.append(line)
    return table


def claims_of(scores: Scores) -> list[dict[str, str]]:
    """What was wanted of the tuned peak rating, cell by cell: against BC on clean data, else against the best q-BC."""
    claims = []
    for (trio, task, std, scale), methods in sorted(scores.items()):
        if "peak" not in methods:
            continue
        fixed = {m: median(r) for m, r in methods.items() if m.startswith("q_bc")}
        if task == "clean" and "bc" in methods:
            name, wanted, share = "BC", median(methods["bc"]), 0.95
        elif scale != 1 and "peak" in scores.get((trio, task, std, 1.0), {}):
            name, wanted, share = "peak at scale 1", median(scores[trio, task, std, 1.0]["peak"]), 0.95
        elif fixed:
            best = max(fixed, key=fixed.__getitem__)
            name, wanted, share = f"best q-BC ({label_of(best)})", fixed[best], 0.9
        else:
            continue
        value = median(methods["peak"])
        line = {"trio": trio, "task": task, "std": f"{std:g}", "scale": f"{scale:g}", "compared with": name}
        line |= {"its median": f"{wanted:.0f}", "peak, tuned": f"{value:.0f}", "ratio": f"{value / wanted:.2f}"}
        line["wanted"] = f"at least {share:g}"
        line["holds"] = "yes" if value >= share * wanted else "no"
        claims.append(line)
    return claims


def report(rows: Sequence[Mapping[str, Any]], pictures: Path) -> str:
    """Writes ``regimes.md`` and ``regimes.png``; returns the text."""
    scores = scores_of(rows)
    parts = [f"What was wanted of the peak rating:\n\n{as_markdown(claims_of(scores))}"] if claims_of(scores) else []
    parts.append(f"All of them:\n\n{as_markdown(table_of(scores))}")
    panels: dict[str, dict[str, dict[float, np.ndarray]]] = {}
    for (trio, task, std, scale), methods in sorted(scores.items()):
        if trio == "own" and scale == 1 and task in ("clean", "both"):
            for method in (method for method in MAP if method in methods):
                panels.setdefault(task, {}).setdefault(label_of(method), {})[std] = methods[method]
    if panels:
        level = "standard deviation of the experts' actions"
        returns_by_level(panels, pictures / "regimes.png", level=level, title="Imitation of the Ant")
    text = "\n".join(parts)
    with atomic_path(pictures / "regimes.md") as path:
        path.write_text(text, encoding="utf-8")
    return text
