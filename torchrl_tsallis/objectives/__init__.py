"""Losses that take a rating, and target updaters."""

from __future__ import annotations

from torchrl_tsallis.objectives.bc import TsallisBCLoss
from torchrl_tsallis.objectives.cat import CATSoftUpdate
from torchrl_tsallis.objectives.predictive import PredictiveBCLoss
from torchrl_tsallis.objectives.wrapper import RatedLoss

__all__ = ["CATSoftUpdate", "PredictiveBCLoss", "RatedLoss", "TsallisBCLoss"]
