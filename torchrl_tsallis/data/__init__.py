"""Demonstrations: corruptions of them, and the buffers that training samples from."""

from __future__ import annotations

from torchrl_tsallis.data.corruptions import TASKS, add_action_noise, make_task, replace_with_amateur
from torchrl_tsallis.data.replay import make_replay_buffer

__all__ = ["TASKS", "add_action_noise", "make_replay_buffer", "make_task", "replace_with_amateur"]
