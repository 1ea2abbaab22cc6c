"""Runs: folders that can act and rate, and how they are made."""

from __future__ import annotations

from torchrl_tsallis.runs.opened import Run
from torchrl_tsallis.runs.source import Source, load_source

__all__ = ["Run", "Source", "load_source"]
