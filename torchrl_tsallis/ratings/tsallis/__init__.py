"""The paper's rating, its equations and its tuner."""

from __future__ import annotations

from torchrl_tsallis.ratings.tsallis.rating import TsallisRating
from torchrl_tsallis.ratings.tsallis.tuner import QTuner, q_gradient, q_objective, q_of_phi

__all__ = ["QTuner", "TsallisRating", "q_gradient", "q_objective", "q_of_phi"]
