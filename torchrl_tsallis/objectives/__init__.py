"""Losses and target updaters."""

from __future__ import annotations

from torchrl_tsallis.objectives.bc import TsallisBCLoss
from torchrl_tsallis.objectives.cat import CATSoftUpdate
from torchrl_tsallis.objectives.predictive import PredictiveBCLoss
from torchrl_tsallis.objectives.reference import MixtureReference, Reference, ReferenceDensity

__all__ = [
    "CATSoftUpdate",
    "MixtureReference",
    "PredictiveBCLoss",
    "Reference",
    "ReferenceDensity",
    "TsallisBCLoss",
]
