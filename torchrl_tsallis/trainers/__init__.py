"""Trainer hooks, and the offline trainer's assembly."""

from __future__ import annotations

from torchrl_tsallis.trainers.checkpoint_files import UnsafeCheckpointError, check_checkpoint
from torchrl_tsallis.trainers.checkpoints import resume
from torchrl_tsallis.trainers.hooks import EvaluationHook, LogMembers
from torchrl_tsallis.trainers.log_adapters import ADAPTERS
from torchrl_tsallis.trainers.log_base import LogAdapter
from torchrl_tsallis.trainers.logging import LoggerGroup, make_logger
from torchrl_tsallis.trainers.memory import keep_freed_memory
from torchrl_tsallis.trainers.offline import SampleHook, make_offline_trainer
from torchrl_tsallis.trainers.schedule import ScheduleHook
from torchrl_tsallis.trainers.start import OfflineClock
from torchrl_tsallis.trainers.stepper import GuardedStepper

__all__ = [
    "ADAPTERS",
    "EvaluationHook",
    "GuardedStepper",
    "LogAdapter",
    "LogMembers",
    "LoggerGroup",
    "OfflineClock",
    "SampleHook",
    "ScheduleHook",
    "UnsafeCheckpointError",
    "check_checkpoint",
    "keep_freed_memory",
    "make_logger",
    "make_offline_trainer",
    "resume",
]
