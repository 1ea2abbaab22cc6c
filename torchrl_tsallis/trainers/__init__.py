"""Trainer hooks, and the offline trainer's assembly."""

from __future__ import annotations

from torchrl_tsallis.trainers.q_tuner import QTuner, q_objective, q_of_phi

__all__ = ["QTuner", "q_objective", "q_of_phi"]
