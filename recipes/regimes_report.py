"""Table and map of recipes/ant_regimes.py, from the raw returns alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ant_units import as_csv

from torchrl_tsallis.jobs import atomic_path


def save_raw(path: str | Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes raw returns as CSV, atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(as_csv(rows), encoding="utf-8")


def report(rows: Sequence[Mapping[str, Any]], pictures: Path) -> str:
    """To be written."""
    return ""
