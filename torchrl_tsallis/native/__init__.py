"""Kernels in C++ for what a training step spends its time on: an extra, which is built by a command of its own.

``python -m torchrl_tsallis.native build`` builds it. From then on the modules use it where it fits: float32 on a CPU
with AVX2 or AVX-512. ``TSALLIS_NATIVE=0`` in the environment leaves it off.
"""

from __future__ import annotations

from torchrl_tsallis.native.library import active, info, is_available, used

__all__ = ["active", "info", "is_available", "used"]
