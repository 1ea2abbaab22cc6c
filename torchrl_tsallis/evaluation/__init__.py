"""Evaluation: parallel rollouts, statistics, plots and videos."""

from __future__ import annotations

from torchrl_tsallis.evaluation.actor_policy import ActorPolicy
from torchrl_tsallis.evaluation.flip_plots import error_curves, flip_trajectories, force_over_time, ratings_over_time
from torchrl_tsallis.evaluation.flip_trials import FlipTrial, longest_single_run, run_flip_trial
from torchrl_tsallis.evaluation.grid_plots import returns_grid
from torchrl_tsallis.evaluation.level_plots import returns_by_level
from torchrl_tsallis.evaluation.mean_policy import MeanPolicy
from torchrl_tsallis.evaluation.plots import auroc_bars, rating_histogram, return_by_method, schedule
from torchrl_tsallis.evaluation.recurrent_policy import RecurrentMeanPolicy
from torchrl_tsallis.evaluation.rollouts import evaluate_policies
from torchrl_tsallis.evaluation.statistics import (
    auroc,
    bootstrap_interval,
    improvement_interval,
    iqm,
    median,
    probability_of_improvement,
)
from torchrl_tsallis.evaluation.video import record_rollout

__all__ = [
    "ActorPolicy",
    "FlipTrial",
    "MeanPolicy",
    "RecurrentMeanPolicy",
    "auroc",
    "auroc_bars",
    "bootstrap_interval",
    "error_curves",
    "evaluate_policies",
    "flip_trajectories",
    "force_over_time",
    "improvement_interval",
    "iqm",
    "longest_single_run",
    "median",
    "probability_of_improvement",
    "rating_histogram",
    "ratings_over_time",
    "record_rollout",
    "return_by_method",
    "returns_by_level",
    "returns_grid",
    "run_flip_trial",
    "schedule",
]
