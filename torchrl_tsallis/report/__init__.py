"""From the folder of a rating to a page that people read, and to TorchRL's loggers."""

from __future__ import annotations

from torchrl_tsallis.report.log import log_ratings
from torchrl_tsallis.report.page import write_report

__all__ = ["log_ratings", "write_report"]
