"""Noise-robust behavioral cloning for TorchRL, by adaptive absolute-relative ratings from Tsallis statistics."""

from __future__ import annotations

from torchrl_tsallis.objectives import CATSoftUpdate, PredictiveBCLoss, TsallisBCLoss
from torchrl_tsallis.optim import AdaTerm
from torchrl_tsallis.trainers import QTuner
from torchrl_tsallis.version import __version__

__all__ = ["AdaTerm", "CATSoftUpdate", "PredictiveBCLoss", "QTuner", "TsallisBCLoss", "__version__"]
