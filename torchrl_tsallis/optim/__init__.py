"""Optimizers."""

from __future__ import annotations

from torchrl_tsallis.optim.adaterm import AdaTerm

__all__ = ["AdaTerm"]
