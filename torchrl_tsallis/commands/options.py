"""Options that several commands have, and how they answer."""

from __future__ import annotations

import importlib.util
import json
import os
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro


def say(answer: dict[str, Any], text: str, as_json: bool) -> None:
    """Writes an answer to stdout, as text or as one object of JSON."""
    sys.stdout.write((json.dumps(answer, default=str) if as_json else text) + "\n")


def note(text: str) -> None:
    """Writes a line to stderr."""
    sys.stderr.write(f"tsallis: {' '.join(text.split())}\n")


def command_line(words: Sequence[str]) -> str:
    """The command as a shell takes it."""
    return shlex.join(["tsallis", *words])


@dataclass(kw_only=True)
class Reads:
    """What is read of a file of demonstrations.

    Args:
        path: file or folder: Minari, robomimic, LeRobot, TED, npz or CSV.
        obs: keys of the observation, * for any letters. Default: all vectors that the format calls observations.
        action: key of the action, or keys of its columns. Default: what the format calls action.
        episode: key of the episode's number (npz, CSV).
        format: name of the format. Default: found by looking at the path.
        filter_key: a mask of robomimic, or a split of LeRobot. Default: all episodes.
        json: whether to answer with an object of JSON, without a progress bar.
    """

    path: tyro.conf.Positional[Path]
    obs: tuple[str, ...] = ()
    action: tuple[str, ...] = ()
    episode: str | None = None
    format: str | None = None
    filter_key: str | None = None
    json: bool = False

    def chosen(self) -> dict[str, Any]:
        """Arguments of :func:`~torchrl_tsallis.run.rate` and :func:`~torchrl_tsallis.run.train`."""
        action = self.action[0] if len(self.action) == 1 else self.action or None
        common = {"episode": self.episode, "format": self.format, "filter_key": self.filter_key}
        return {"obs": self.obs or None, "action": action, **common}


@dataclass(kw_only=True)
class Logs:
    """Loggers of TorchRL that get the ratings too.

    Args:
        log: tensorboard or wandb, which get the episodes as a table and the surprise of the steps as a histogram. W&B
            needs no account: it writes a folder that wandb sync uploads later.
        log_dir: folder of the logs. Default: logs, beside the folder of the ratings.
    """

    log: Literal["tensorboard", "wandb"] | None = None
    log_dir: Path | None = None

    def check_log(self) -> None:
        """Refuses what cannot be logged, before anything is done.

        Raises:
            ImportError: if the logger's package is not installed.
            OSError: if the folder, or the one that it would be made in, cannot be written.
            ValueError: if there is a folder, and nothing to write to it.
        """
        if self.log is None and self.log_dir is not None:
            raise ValueError(
                "--log-dir is the folder of --log, which is not given: add --log tensorboard or --log wandb"
            )
        if self.log is not None and importlib.util.find_spec(self.log) is None:
            raise ImportError(f"--log {self.log} needs {self.log}: pip install {self.log}")
        if self.log_dir is not None:
            place = self.log_dir.expanduser().absolute()
            there = next(folder for folder in (place, *place.parents) if folder.exists())
            if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
                raise OSError(f"nothing can be written under {str(there)!r}: choose another --log-dir")

    def send(self, folder: Path) -> Path | None:
        """Logs the ratings in a folder; returns where that was written, None without ``--log``."""
        if self.log is None:
            return None
        from torchrl_tsallis.report import log_ratings
        from torchrl_tsallis.runs import Run
        from torchrl_tsallis.trainers import make_logger

        place = folder.expanduser().resolve()
        logs = place.parent / "logs" if self.log_dir is None else self.log_dir.expanduser()
        run = Run.open(folder)
        logger = make_logger(self.log, logs, place.name, tags=["ratings"])
        try:
            logger.log_hparams({name: run.settings[name] for name in ("data", "method", "train", "command")})
            log_ratings(folder, logger)
        finally:
            logger.shutdown()
        return logs


@dataclass
class RateTraining:
    """How the policies that rate are trained.

    Args:
        steps: gradient steps. Default: 40 passes, from 1000 to 10,000 steps.
        seeds: replications, which the intervals are over; at least 2 for a verdict.
        folds: parts of which one is held out at a time.
        batch_size: samples a step and policy.
    """

    steps: int | None = None
    seeds: int = 3
    folds: int = 2
    batch_size: int = 256


@dataclass
class PolicyTraining:
    """How the policy is trained.

    Args:
        steps: gradient steps. Default: 40 passes, from 1000 to 10,000 steps.
        seed: of its first parameters and of the samples' order.
        batch_size: samples a step.
    """

    steps: int | None = None
    seed: int = 0
    batch_size: int = 256


@dataclass
class ModesTraining:
    """How the mixtures are trained.

    Args:
        starts: of mixtures, which have to agree on the modes.
        updates: of the responsibilities, an epoch between two.
        batch_size: samples a step and component.
        seed: of starts and policies.
    """

    starts: int = 4
    updates: int = 60
    batch_size: int = 256
    seed: int = 0
