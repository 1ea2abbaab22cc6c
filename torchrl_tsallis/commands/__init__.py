"""The commands of ``tsallis``: dataclasses whose fields are the options, thin over Python functions.

Each is called with the words of its command line, says what it did on stdout (with ``--json`` as one object), and gives
its exit code.
"""

from __future__ import annotations

from typing import Any

from torchrl_tsallis.commands.data import Info, Modes, Rate, Train
from torchrl_tsallis.commands.folders import Curate, Export, Report

__all__ = ["COMMANDS"]

#: The commands by name.
COMMANDS: dict[str, Any] = {
    "info": Info,
    "rate": Rate,
    "report": Report,
    "modes": Modes,
    "curate": Curate,
    "train": Train,
    "export": Export,
}
