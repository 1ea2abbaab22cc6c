"""Ratings: how much a sample counts in imitation, and what tunes that.

A rating is one file: the paper's equations beside the paper's rating in :mod:`torchrl_tsallis.ratings.tsallis`, the
rating without units in ``peak``. Nothing here knows of losses' tensordicts or trainers' loops; a tuner is a hook that
TorchRL's trainer calls.
"""

from __future__ import annotations

from torchrl_tsallis.ratings.base import Evidence, Rated, Rating
from torchrl_tsallis.ratings.batch import Batch
from torchrl_tsallis.ratings.peak import PeakRating
from torchrl_tsallis.ratings.score_tuner import ScoreTuner, hyvarinen_score
from torchrl_tsallis.ratings.tsallis import QTuner, TsallisRating
from torchrl_tsallis.ratings.tuner import RatingTuner

__all__ = [
    "Batch",
    "Evidence",
    "PeakRating",
    "QTuner",
    "Rated",
    "Rating",
    "RatingTuner",
    "ScoreTuner",
    "TsallisRating",
    "hyvarinen_score",
]
