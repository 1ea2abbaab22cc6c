"""Losses that take a rating, and target updaters."""

from __future__ import annotations

from torchrl_tsallis.objectives.bc import TsallisBCLoss
from torchrl_tsallis.objectives.cat import CATSoftUpdate
from torchrl_tsallis.objectives.predictive import PredictiveBCLoss

__all__ = ["CATSoftUpdate", "PredictiveBCLoss", "TsallisBCLoss"]
