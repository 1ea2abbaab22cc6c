"""Simulated robots on which the recipes record data and evaluate policies."""

from __future__ import annotations

from torchrl_tsallis.envs.ant import ENV_ID, make_ant, register_ant

__all__ = ["ENV_ID", "make_ant", "register_ant"]
