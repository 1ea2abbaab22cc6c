"""Networks of the paper."""

from __future__ import annotations

from torchrl_tsallis.modules.activations import Squish, squareplus, squish
from torchrl_tsallis.modules.linear import Linear
from torchrl_tsallis.modules.norm import RMSNorm
from torchrl_tsallis.modules.policy import NormalHead, make_policy
from torchrl_tsallis.modules.recurrent import NoisyLSTM, make_recurrent_policy

__all__ = [
    "Linear",
    "NoisyLSTM",
    "NormalHead",
    "RMSNorm",
    "Squish",
    "make_policy",
    "make_recurrent_policy",
    "squareplus",
    "squish",
]
