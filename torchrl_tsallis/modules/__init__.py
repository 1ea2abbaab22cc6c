"""Networks of the paper."""

from __future__ import annotations

from torchrl_tsallis.modules.activations import Squish, squareplus, squish
from torchrl_tsallis.modules.policy import NormalHead, make_policy

__all__ = ["NormalHead", "Squish", "make_policy", "squareplus", "squish"]
