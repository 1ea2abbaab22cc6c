"""What every test leaves as it was."""

from __future__ import annotations

import pytest
from torchrl import torchrl_logger


@pytest.fixture(autouse=True)
def _same_log_level():
    """Recipes that run in a test make TorchRL's logger quieter, which would silence the warnings of later tests."""
    level = torchrl_logger.level
    yield
    torchrl_logger.setLevel(level)
