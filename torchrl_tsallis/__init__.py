"""Noise-robust behavioral cloning for TorchRL, by adaptive absolute-relative ratings from Tsallis statistics."""

from __future__ import annotations

from torchrl_tsallis.objectives import CATSoftUpdate, PredictiveBCLoss, RatedLoss, TsallisBCLoss
from torchrl_tsallis.optim import AdaTerm
from torchrl_tsallis.ratings import PeakRating, QTuner, Rating, ScoreTuner, TsallisRating
from torchrl_tsallis.version import __version__

__all__ = [
    "AdaTerm",
    "CATSoftUpdate",
    "PeakRating",
    "PredictiveBCLoss",
    "QTuner",
    "RatedLoss",
    "Rating",
    "ScoreTuner",
    "TsallisBCLoss",
    "TsallisRating",
    "__version__",
]
