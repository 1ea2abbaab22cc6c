"""Simulated robots on which the recipes record data and evaluate policies."""

from __future__ import annotations

from torchrl_tsallis.envs.ant import ENV_ID, make_ant, register_ant
from torchrl_tsallis.envs.flips import FlipCount, count_flips
from torchrl_tsallis.envs.page_flip import PAGE_FLIP_ID, make_page_flip, register_page_flip

__all__ = [
    "ENV_ID",
    "PAGE_FLIP_ID",
    "FlipCount",
    "count_flips",
    "make_ant",
    "make_page_flip",
    "register_ant",
    "register_page_flip",
]
