"""Loggers of a run: CSV always, TensorBoard or W&B beside it; W&B needs neither account nor network."""

from __future__ import annotations

import os
import re
import uuid
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from torchrl.record.loggers.common import Logger
from torchrl.record.loggers.csv import CSVLogger

from torchrl_tsallis._checks import check_path, check_text, shown
from torchrl_tsallis.jobs import atomic_path, check_writable, disk_errors
from torchrl_tsallis.trainers.log_adapters import adapter_of, sorted_columns
from torchrl_tsallis.trainers.log_base import LogAdapter

Kind = Literal["csv", "tensorboard", "wandb"]
#: Seconds that W&B may take to answer before the run is kept offline; ``WANDB_INIT_TIMEOUT`` overrides it.
TIMEOUT = 30


def check_name(name: str, *, what: str = "name") -> str:
    """Refuses a name that would lead out of the folder in which a file of this name is made.

    Args:
        name: of a quantity, as ``eval/return``.
        what: for the message.

    Returns:
        The name.

    Raises:
        ValueError: if it is empty, absolute, or has an empty part, ``.``, ``..``, a backslash or a NUL.

    Examples:
        >>> check_name("eval/return")
        'eval/return'
    """
    parts = name.split("/") if isinstance(name, str) else [""]
    if (
        any(part in ("", ".", "..") for part in parts)
        or len(name.encode(errors="replace")) > 1000
        or set(name) & set("\\\0")
        or re.match("[A-Za-z]:", name)
    ):
        raise ValueError(
            f"{what} {shown(name)} leads out of its folder: use letters, digits, and / between the parts of a quantity"
        )
    return name


class LoggerGroup(Logger):
    """Sends everything to several of TorchRL's loggers, and knows their forms of pictures, videos and tables.

    Args:
        loggers: the loggers; the first one decides about name and folder.

    Raises:
        ValueError: if there is no logger. A quantity's name that leads out of its folder is refused where it is logged.
        OSError: where something is logged, if the disk is full or read-only; the message names the path.

    Examples:
        >>> import tempfile
        >>> group = LoggerGroup([CSVLogger("bc", tempfile.mkdtemp())])
        >>> group.log_scalar("loss", 1.0, step=3)
        >>> group.last_step()
        3
    """

    def __init__(self, loggers: Sequence[Logger]) -> None:
        if not isinstance(loggers, (list, tuple)) or not all(hasattr(logger, "log_scalar") for logger in loggers):
            raise TypeError(f"loggers must be a list of TorchRL's loggers, got {shown(loggers)}")
        if not loggers:
            raise ValueError("a group needs at least one logger: loggers is empty")
        self.loggers = list(loggers)
        self.adapters = [adapter_of(logger) for logger in loggers]
        super().__init__(self.loggers[0].exp_name, self.loggers[0].log_dir)

    def _create_experiment(self) -> None:
        """The loggers have their own."""

    def _each(self, log: Callable[[LogAdapter], Any]) -> None:
        """Does something by every adapter."""
        for adapter in self.adapters:
            with disk_errors(adapter.folder):
                log(adapter)

    def log_scalar(self, name: str, value: float, step: int | None = None) -> None:
        """Logs a number."""
        check_name(name)
        self._each(lambda adapter: adapter.scalar(name, value, step))

    def log_hparams(self, cfg: Mapping[str, Any]) -> None:
        """Logs the configuration, nested or not."""
        flat = _flatten(cfg)
        self._each(lambda adapter: adapter.hparams(cfg, flat))

    def log_histogram(self, name: str, data: Any, step: int | None = None, **kwargs: Any) -> None:
        """Logs the distribution of numbers, where a logger can (CSV cannot)."""
        check_name(name)
        values = np.asarray(data, dtype=np.float64).ravel()
        self._each(lambda adapter: adapter.histogram(name, values, step))

    def log_video(self, name: str, video: Any, step: int | None = None, **kwargs: Any) -> None:
        """Logs a video file (path to ``.mp4`` or ``.gif``), where a logger can; the file itself stays."""
        check_name(name)
        self._each(lambda adapter: adapter.video(name, Path(video), step))

    def log_picture(self, name: str, path: str | os.PathLike[str], step: int | None = None) -> None:
        """Logs a picture file (``.png``), where a logger can."""
        check_name(name)
        self._each(lambda adapter: adapter.picture(name, Path(path), step))

    def log_table(self, name: str, rows: Sequence[Mapping[str, Any]]) -> None:
        """Logs rows of equal columns, as a table in W&B and as text in TensorBoard."""
        check_name(name)
        columns, cells = sorted_columns(rows)
        self._each(lambda adapter: adapter.table(name, columns, cells))

    def last_step(self) -> int | None:
        """The largest step in the loggers' files; None if they have none."""
        return max((s for adapter in self.adapters if (s := adapter.last_step()) is not None), default=None)

    def cut(self, step: int) -> None:
        """Removes the rows of later steps, so that a resumed training logs none of them twice.

        CSV and TensorBoard files are written anew without them. W&B takes nothing back: what it has of the later steps
        by the files of the first logger is not sent again. The training is resumed bit for bit, so it is the same.

        Args:
            step: the last one that stays.
        """
        known: dict[str, int] = {}
        for adapter in self.adapters:
            with disk_errors(adapter.folder):
                known |= adapter.cut(step, known)

    def shutdown(self, timeout: float | None = None) -> None:
        """Closes all of them."""
        self._each(lambda adapter: adapter.close())
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

    W&B goes online only where an account is set up (``wandb login`` or ``WANDB_API_KEY``) and the server answers within
    30 s; otherwise it writes a folder that ``wandb sync`` accepts later. ``WANDB_MODE`` decides before both. A run that
    is resumed continues its W&B run.

    Args:
        kind: ``"csv"``, ``"tensorboard"`` or ``"wandb"``.
        folder: where everything is written.
        name: of the run, one folder below it.
        project: of W&B.
        group: of W&B.
        tags: of W&B.

    Returns:
        The loggers.

    Raises:
        ValueError: if there is no such logger, or the name is no folder's.
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
    if not isinstance(kind, str) or kind not in ("csv", "tensorboard", "wandb"):
        raise ValueError(f"no logger {shown(kind)}: choose csv, tensorboard or wandb")
    if "/" in check_name(name, what="the run's name"):
        raise ValueError(f"the run's name {name!r} holds a /: put the folders above it into folder")
    check_text("project", project)
    if group is not None:
        check_text("group", group)
    if not isinstance(tags, (list, tuple)) or not all(isinstance(tag, str) for tag in tags):
        raise TypeError(f"tags must be a sequence of strings, got {shown(tags)}")
    root = Path(check_path("folder", folder))
    check_writable(root / name)
    loggers: list[Logger] = [CSVLogger(name, str(root))]
    if kind == "tensorboard":
        from torchrl.record.loggers.tensorboard import TensorboardLogger

        loggers.append(TensorboardLogger(name, str(root / "tensorboard")))
    elif kind == "wandb":
        loggers.append(_wandb(root, name, {"project": project, "group": group, "tags": list(tags)}))
    return LoggerGroup(loggers)


def _wandb(root: Path, name: str, settings: dict[str, Any]) -> Logger:
    """A W&B run, online where that is set up and works."""
    import wandb
    from torchrl.record.loggers.wandb import WandbLogger

    file = root / name / "wandb_id.txt"
    settings |= {"save_dir": str(root / name), "log_env_packages": False, "reinit": "create_new"}
    if "WANDB_INIT_TIMEOUT" not in os.environ:
        settings["settings"] = wandb.Settings(init_timeout=TIMEOUT)
    try:
        if "WANDB_MODE" not in os.environ and not wandb.login(prompt=False):
            settings["mode"] = "offline"
            os.environ.setdefault("WANDB_SILENT", "true")  # it would print a page a run; online it shows the address
        return WandbLogger(name, id=_wandb_id(file), **settings)
    except Exception as error:  # wandb raises many kinds for a server that does not answer, or not as it should
        warnings.warn(f"W&B refused the run ({error}): logging off-line; use `wandb sync` later", stacklevel=3)
        file.unlink(missing_ok=True)  # the refused run goes on holding its id in this process
        return WandbLogger(name, id=_wandb_id(file), **(settings | {"mode": "offline"}))


def _wandb_id(file: Path) -> str:
    """The run's id, kept in a file so that a resumed run continues it."""
    if not file.exists():
        with atomic_path(file) as temporary:
            temporary.write_text(uuid.uuid4().hex[:8])
    return file.read_text()
