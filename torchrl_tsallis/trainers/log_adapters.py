"""What TorchRL's loggers make of a scalar, a histogram, a picture, a table or a video."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from torchrl.record.loggers.common import Logger
from torchrl.record.loggers.csv import CSVLogger
from torchrl.record.loggers.tensorboard import TensorboardLogger
from torchrl.record.loggers.wandb import WandbLogger

from torchrl_tsallis.jobs import atomic_path
from torchrl_tsallis.trainers.log_base import LogAdapter
from torchrl_tsallis.trainers.log_csv import CSVAdapter


class TensorboardAdapter(LogAdapter):
    """TensorBoard's event files; of the videos it shows animated GIFs."""

    @property
    def folder(self) -> Path:
        """Where the event files are."""
        return Path(self.logger.log_dir)

    def histogram(self, name: str, values: np.ndarray, step: int | None) -> None:
        """Logs the distribution of numbers."""
        self.logger.log_histogram(name, values, step=step, bins="tensorflow")

    def picture(self, name: str, path: Path, step: int | None) -> None:
        """Logs a picture file."""
        from PIL import Image

        with Image.open(path) as image:
            self.logger.experiment.add_image(name, np.asarray(image.convert("RGB")), step, dataformats="HWC")

    def table(self, name: str, columns: list[str], rows: list[list[Any]]) -> None:
        """Logs rows as a table of Markdown."""
        texts = [["" if value is None else str(value) for value in row] for row in (columns, *rows)]
        cells = [[" ".join(text.split()).replace("|", "\\|") for text in row] for row in texts]
        lines = [cells[0], ["---"] * len(columns), *cells[1:]]
        self.logger.experiment.add_text(name, "\n".join("|" + "|".join(line) + "|" for line in lines))

    def video(self, name: str, path: Path, step: int | None) -> None:
        """Logs an animated GIF as the image that it is; TensorBoard plays it."""
        if path.suffix != ".gif":
            return
        from PIL import Image
        from tensorboard.compat.proto.summary_pb2 import Summary

        with Image.open(path) as image:
            width, height = image.size
        content = Summary.Image(width=width, height=height, colorspace=3, encoded_image_string=path.read_bytes())
        self.logger.experiment.file_writer.add_summary(Summary(value=[Summary.Value(tag=name, image=content)]), step)

    def _events(self, path: Path) -> Iterator[tuple[bytes, Any]]:
        """The records of a file with what is in them; an unfinished last one is left out."""
        from tensorboard.backend.event_processing.event_file_loader import RawEventFileLoader
        from tensorboard.compat.proto.event_pb2 import Event

        for record in RawEventFileLoader(str(path)).Load():
            yield record, Event.FromString(record)

    def _paths(self) -> list[Path]:
        return sorted(path for path in self.folder.glob("events.out.tfevents.*") if path.is_file())

    def last_step(self) -> int | None:
        """See :meth:`LogAdapter.last_step`."""
        self.logger.experiment.flush()
        events = itertools.chain.from_iterable(map(self._events, self._paths()))
        return max((event.step for _, event in events if event.HasField("summary")), default=None)

    def cut(self, step: int, known: Mapping[str, int]) -> dict[str, int]:
        """See :meth:`LogAdapter.cut`."""
        from tensorboard.summary.writer.record_writer import RecordWriter

        self.logger.experiment.close()  # it opens another file as soon as something is logged
        for path in self._paths():
            events = list(self._events(path))
            kept = [record for record, event in events if not event.HasField("summary") or event.step <= step]
            if len(kept) < len(events):
                with atomic_path(path) as temporary, temporary.open("wb") as file:
                    writer = RecordWriter(file)
                    for record in kept:
                        writer.write(record)
                    writer.flush()
        return {}


class WandbAdapter(LogAdapter):
    """A run of W&B, online or offline. Its rows cannot be taken back: those that it has are not sent again."""

    def __init__(self, logger: WandbLogger) -> None:
        super().__init__(logger)
        self.sent: dict[str, int] = {}

    @property
    def folder(self) -> Path:
        """Where the run is kept until it is uploaded."""
        return Path(self.logger.log_dir or "wandb")

    def scalar(self, name: str, value: float, step: int | None) -> None:
        """Logs a number, unless the run has that step of it."""
        if step is None or step > self.sent.get(name, -1):
            self.logger.log_scalar(name, value, step=step)

    def hparams(self, nested: Mapping[str, Any], flat: Mapping[str, Any]) -> None:
        """Logs a configuration as it is."""
        self.logger.log_hparams(dict(nested))

    def histogram(self, name: str, values: np.ndarray, step: int | None) -> None:
        """Logs the distribution of numbers."""
        self.logger.log_histogram(name, values, step=step, bins=64)

    def picture(self, name: str, path: Path, step: int | None) -> None:
        """Logs a picture file."""
        import wandb

        self.logger.experiment.log({name: wandb.Image(str(path))})

    def table(self, name: str, columns: list[str], rows: list[list[Any]]) -> None:
        """Logs rows as a table."""
        import wandb

        self.logger.experiment.log({name: wandb.Table(columns=[*columns], data=rows)})

    def video(self, name: str, path: Path, step: int | None) -> None:
        """Logs a video file."""
        import wandb

        self.logger.experiment.log({name: wandb.Video(str(path), format=cast(Any, path.suffix[1:]))})

    def cut(self, step: int, known: Mapping[str, int]) -> dict[str, int]:
        """See :meth:`LogAdapter.cut`: rows up to the last known step are left out when they come again."""
        self.sent = {name: last for name, last in known.items() if last > step}
        return {}


#: Class of a logger -> its adapter.
ADAPTERS: dict[type[Logger], type[LogAdapter]] = {
    CSVLogger: CSVAdapter,
    TensorboardLogger: TensorboardAdapter,
    WandbLogger: WandbAdapter,
}


def adapter_of(logger: Any) -> LogAdapter:
    """The adapter of a logger, by its class or the nearest of its parents."""
    found = [ADAPTERS[kind] for kind in type(logger).__mro__ if kind in ADAPTERS]
    return (found or [LogAdapter])[0](logger)


def sorted_columns(rows: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[list[Any]]]:
    """Columns and cells of rows of equal columns.

    Raises:
        ValueError: if there is no row, or the columns differ.
    """
    columns = list(rows[0]) if rows else []
    if not columns or any(set(row) != set(columns) for row in rows):
        raise ValueError(f"a table needs rows of equal columns, got {[list(row) for row in rows[:3]]}")
    return columns, [[row[column] for column in columns] for row in rows]
