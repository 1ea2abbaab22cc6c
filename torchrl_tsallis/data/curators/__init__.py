"""Copies of demonstrations without some episodes or steps, each in the format that came in."""

from __future__ import annotations

# Each import registers a format.
from torchrl_tsallis.data.curators import lerobot as _lerobot  # noqa: F401
from torchrl_tsallis.data.curators import minari as _minari  # noqa: F401
from torchrl_tsallis.data.curators import robomimic as _robomimic  # noqa: F401
from torchrl_tsallis.data.curators import table as _table  # noqa: F401
from torchrl_tsallis.data.curators import ted as _ted  # noqa: F401
from torchrl_tsallis.data.curators.base import CURATORS, Curator, Plan, register

__all__ = ["CURATORS", "Curator", "Plan", "register"]
