"""Demonstrations: recording, storage, corruptions, and the buffers that training samples from."""

from __future__ import annotations

from torchrl_tsallis.data.corruptions import TASKS, add_action_noise, make_task, replace_pairs, replace_with_amateur
from torchrl_tsallis.data.demonstrations import (
    load_demonstrations,
    record_trajectory,
    save_demonstrations,
    validate_demonstrations,
)
from torchrl_tsallis.data.episodes import Episodes, find_episodes
from torchrl_tsallis.data.findings import Finding
from torchrl_tsallis.data.flip_demonstrations import record_flips, replay_forces
from torchrl_tsallis.data.hygiene import inspect_demonstrations
from torchrl_tsallis.data.policy import NumpyPolicy, load_policy
from torchrl_tsallis.data.replay import make_replay_buffer
from torchrl_tsallis.data.robust_scaling import RobustScaling
from torchrl_tsallis.data.scaling import Scaling
from torchrl_tsallis.data.sequences import make_sequence_buffer
from torchrl_tsallis.data.splits import fold_episodes, split_episodes, split_trajectories
from torchrl_tsallis.data.stacked import MemberSampler, make_stacked_replay_buffer
from torchrl_tsallis.data.teleoperation import FlipOperator

__all__ = [
    "TASKS",
    "Episodes",
    "Finding",
    "FlipOperator",
    "MemberSampler",
    "NumpyPolicy",
    "RobustScaling",
    "Scaling",
    "add_action_noise",
    "find_episodes",
    "fold_episodes",
    "inspect_demonstrations",
    "load_demonstrations",
    "load_policy",
    "make_replay_buffer",
    "make_sequence_buffer",
    "make_stacked_replay_buffer",
    "make_task",
    "record_flips",
    "record_trajectory",
    "replace_pairs",
    "replace_with_amateur",
    "replay_forces",
    "save_demonstrations",
    "split_episodes",
    "split_trajectories",
    "validate_demonstrations",
]
