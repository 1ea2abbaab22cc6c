"""One face for TorchRL's loggers: a scalar, a histogram, a picture, a table or a video."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_tsallis._torchrl import logger as torchrl_logger


class LogAdapter:
    """Any of TorchRL's loggers; what it does not offer is left out. Subclass it and add the class to ``ADAPTERS``.

    Args:
        logger: that gets everything.
    """

    def __init__(self, logger: Any) -> None:
        self.logger = logger

    @property
    def folder(self) -> Path:
        """Where the logger writes."""
        return Path(self.logger.log_dir or ".", self.logger.exp_name)

    def scalar(self, name: str, value: float, step: int | None) -> None:
        """Logs a number."""
        self.logger.log_scalar(name, value, step=step)

    def hparams(self, nested: Mapping[str, Any], flat: Mapping[str, Any]) -> None:
        """Logs a configuration, which is given in both forms."""
        self.logger.log_hparams(dict(flat))

    def histogram(self, name: str, values: np.ndarray, step: int | None) -> None:
        """Logs the distribution of numbers."""

    def picture(self, name: str, path: Path, step: int | None) -> None:
        """Logs a picture file."""

    def table(self, name: str, columns: list[str], rows: list[list[Any]]) -> None:
        """Logs rows of equal columns."""

    def video(self, name: str, path: Path, step: int | None) -> None:
        """Logs a video file."""

    def last_step(self) -> int | None:
        """The largest step in the logger's files; None if there is none, or they cannot be read."""
        return None

    def cut(self, step: int, known: Mapping[str, int]) -> dict[str, int]:
        """Removes the rows of later steps.

        Args:
            step: the last one that stays.
            known: name -> last logged step, from the loggers that were cut before this one.

        Returns:
            Name -> last step, as it was before the cut, where the logger knows it.
        """
        last = max(known.values(), default=None)
        if last is not None and last > step:
            torchrl_logger.warning("%s cannot be cut: its steps %d to %d are there twice", self.logger, step + 1, last)
        return {}

    def close(self) -> None:
        """Closes the logger."""
        self.logger.shutdown()
