"""Trainer hooks, and the offline trainer's assembly."""

from __future__ import annotations

from torchrl_tsallis.trainers.checkpoints import resume
from torchrl_tsallis.trainers.hooks import EvaluationHook
from torchrl_tsallis.trainers.logging import LoggerGroup, make_logger
from torchrl_tsallis.trainers.memory import keep_freed_memory
from torchrl_tsallis.trainers.offline import GuardedStepper, OfflineClock, SampleHook, make_offline_trainer
from torchrl_tsallis.trainers.stacked import LogMembers, MemberStepper

__all__ = [
    "EvaluationHook",
    "GuardedStepper",
    "LogMembers",
    "LoggerGroup",
    "MemberStepper",
    "OfflineClock",
    "SampleHook",
    "keep_freed_memory",
    "make_logger",
    "make_offline_trainer",
    "resume",
]
