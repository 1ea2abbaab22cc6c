"""Loggers of a run: CSV always, TensorBoard or W&B beside it; W&B needs neither account nor network."""

from __future__ import annotations

import netrc
import os
import socket
import uuid
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit

import numpy as np
from torchrl.record.loggers.common import Logger
from torchrl.record.loggers.csv import CSVLogger

from torchrl_tsallis.jobs import atomic_path

Kind = Literal["csv", "tensorboard", "wandb"]


class LoggerGroup(Logger):
    """Sends everything to several of TorchRL's loggers, and knows their forms of pictures, videos and tables.

    Args:
        loggers: the loggers; the first one decides about name and folder.

    Raises:
        ValueError: if there is no logger.
    """

    def __init__(self, loggers: Sequence[Logger]) -> None:
        if not loggers:
            raise ValueError("a group needs at least one logger")
        self.loggers = list(loggers)
        super().__init__(self.loggers[0].exp_name, self.loggers[0].log_dir)

    def _create_experiment(self) -> None:
        """The loggers have their own."""

    def log_scalar(self, name: str, value: float, step: int | None = None) -> None:
        """Logs a number."""
        for logger in self.loggers:
            logger.log_scalar(name, value, step=step)

    def log_hparams(self, cfg: Mapping[str, Any]) -> None:
        """Logs the configuration, nested or not."""
        flat = _flatten(cfg)
        for logger in self.loggers:
            logger.log_hparams(dict(cfg) if type(logger).__name__ == "WandbLogger" else flat)

    def log_histogram(self, name: str, data: Any, step: int | None = None, **kwargs: Any) -> None:
        """Logs the distribution of numbers, where a logger can (CSV cannot)."""
        values = np.asarray(data, dtype=np.float64).ravel()
        for logger in self.loggers[1:]:
            if type(logger).__name__ == "WandbLogger":
                logger.log_histogram(name, values, step=step, bins=64)
            else:
                logger.log_histogram(name, values, step=step, bins="tensorflow")

    def log_video(self, name: str, video: Any, step: int | None = None, **kwargs: Any) -> None:
        """Logs a video file (path to ``.mp4`` or ``.gif``); without W&B the file itself is the result."""
        self._log_file(name, Path(video), "Video", step)

    def log_picture(self, name: str, path: str | os.PathLike[str], step: int | None = None) -> None:
        """Logs a picture file (``.png``)."""
        self._log_file(name, Path(path), "Image", step)

    def _log_file(self, name: str, path: Path, kind: str, step: int | None) -> None:
        for logger in self.loggers[1:]:
            if type(logger).__name__ == "WandbLogger":
                import wandb

                media = getattr(wandb, kind)(str(path), **({"format": path.suffix[1:]} if kind == "Video" else {}))
                logger.experiment.log({name: media})
            elif kind == "Image":
                from PIL import Image

                pixels = np.asarray(Image.open(path).convert("RGB"))
                logger.experiment.add_image(name, pixels, global_step=step, dataformats="HWC")

    def log_table(self, name: str, rows: Sequence[Mapping[str, Any]]) -> None:
        """Logs rows of equal columns, as a table in W&B and as text in TensorBoard."""
        columns = list(rows[0])
        for logger in self.loggers[1:]:
            if type(logger).__name__ == "WandbLogger":
                import wandb

                table = wandb.Table(columns=[*columns], data=[[row[c] for c in columns] for row in rows])
                logger.experiment.log({name: table})
            else:
                lines = [columns, ["---"] * len(columns), *([str(row[c]) for c in columns] for row in rows)]
                logger.experiment.add_text(name, "\n".join("|" + "|".join(line) + "|" for line in lines))

    def shutdown(self, timeout: float | None = None) -> None:
        """Closes all of them."""
        for logger in self.loggers:
            logger.shutdown()
        self._service_shutdown = True

    def __repr__(self) -> str:
        """Names the loggers."""
        return f"LoggerGroup({self.loggers})"


def _flatten(cfg: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested dictionaries as one level with dots; lists as text."""
    out: dict[str, Any] = {}
    for key, value in cfg.items():
        if isinstance(value, Mapping):
            out |= _flatten(value, f"{prefix}{key}.")
        else:
            out[f"{prefix}{key}"] = value if isinstance(value, (bool, int, float, str)) else str(value)
    return out


def make_logger(
    kind: Kind,
    folder: str | os.PathLike[str],
    name: str,
    *,
    project: str = "torchrl-tsallis",
    group: str | None = None,
    tags: Sequence[str] = (),
) -> LoggerGroup:
    """Makes the loggers of a run: a CSV file per quantity under ``folder/name/scalars``, and what ``kind`` adds.

    W&B goes online only where an account is set up (``wandb login`` or ``WANDB_API_KEY``) and the server answers;
    otherwise it writes a folder that ``wandb sync`` accepts later. A run that is resumed continues its W&B run.

    Args:
        kind: ``"csv"``, ``"tensorboard"`` or ``"wandb"``.
        folder: where everything is written.
        name: of the run.
        project: of W&B.
        group: of W&B.
        tags: of W&B.

    Returns:
        The loggers.

    Raises:
        ValueError: if there is no such logger.
        OSError: if the folder cannot be written.

    Examples:
        >>> import tempfile
        >>> logger = make_logger("csv", tempfile.mkdtemp(), "bc")
        >>> logger.log_scalar("loss", 1.0, step=1)
        >>> make_logger("cvs", ".", "bc")
        Traceback (most recent call last):
        ...
        ValueError: no logger 'cvs': choose csv, tensorboard or wandb
    """
    if kind not in ("csv", "tensorboard", "wandb"):
        raise ValueError(f"no logger {kind!r}: choose csv, tensorboard or wandb")
    root = Path(folder)
    with atomic_path(root / name / ".writable"):  # fails early, with a clear message
        pass
    (root / name / ".writable").unlink()
    loggers: list[Logger] = [CSVLogger(name, str(root))]
    if kind == "tensorboard":
        from torchrl.record.loggers.tensorboard import TensorboardLogger

        loggers.append(TensorboardLogger(name, str(root / "tensorboard")))
    elif kind == "wandb":
        loggers.append(_wandb(root, name, {"project": project, "group": group, "tags": list(tags)}))
    return LoggerGroup(loggers)


def _wandb(root: Path, name: str, settings: dict[str, Any]) -> Logger:
    """A W&B run, online where that is set up and works."""
    from torchrl.record.loggers.wandb import WandbLogger

    file = root / name / "wandb_id.txt"
    settings |= {"save_dir": str(root / name), "log_env_packages": False, "reinit": "create_new"}
    if "WANDB_MODE" not in os.environ:
        settings["mode"] = "offline" if (reason := _why_offline()) else "online"
        if reason and reason != "no account":
            warnings.warn(f"W&B is not reachable ({reason}): logging off-line; use `wandb sync` later", stacklevel=3)
        if reason:
            os.environ.setdefault("WANDB_SILENT", "true")  # it would print a page a run; online it shows the address
    try:
        return WandbLogger(name, id=_wandb_id(file), **settings)
    except Exception as error:  # wandb raises many kinds for a server that answers, but not as it should
        warnings.warn(f"W&B refused the run ({error}): logging off-line; use `wandb sync` later", stacklevel=3)
        file.unlink()  # the refused run goes on holding its id in this process
        return WandbLogger(name, id=_wandb_id(file), **(settings | {"mode": "offline"}))


def _wandb_id(file: Path) -> str:
    """The run's id, kept in a file so that a resumed run continues it."""
    if not file.exists():
        with atomic_path(file) as temporary:
            temporary.write_text(uuid.uuid4().hex[:8])
    return file.read_text()


def _why_offline() -> str | None:
    """Why W&B cannot be used online: no account, or a server that does not answer; None if it can."""
    url = urlsplit(os.environ.get("WANDB_BASE_URL", "https://api.wandb.ai"))
    host, port = url.hostname or "", url.port or (80 if url.scheme == "http" else 443)
    if not _has_account(host):
        return "no account"
    try:
        socket.create_connection((host, port), timeout=10).close()
    except OSError as error:
        return f"{host}:{port}: {error}"
    return None


def _has_account(host: str) -> bool:
    """Whether an API key is in the environment or in the netrc file that ``wandb login`` writes."""
    if os.environ.get("WANDB_API_KEY"):
        return True
    try:
        return netrc.netrc().authenticators(host) is not None
    except (OSError, netrc.NetrcParseError):
        return False
