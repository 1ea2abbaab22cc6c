"""Loggers: CSV always; TensorBoard and W&B beside it, W&B with neither account nor network."""

from __future__ import annotations

import errno
import io
import os
import subprocess
import sys
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread
from typing import ClassVar

import numpy as np
import pytest
from torchrl.record.loggers.csv import CSVLogger

from torchrl_tsallis.trainers import ADAPTERS, LogAdapter, LoggerGroup, make_logger

EVERYTHING = """
import sys
import numpy as np
from PIL import Image
from torchrl_tsallis.trainers import make_logger

folder, kind = sys.argv[1:]
logger = make_logger(kind, folder, "run", group="both/bc", tags=["both"])
logger.log_hparams({"q": 0.8, "data": {"std": 0.2}})
for step in (1, 2):
    logger.log_scalar("loss", 1.0 / step, step=step)
logger.log_histogram("rating/clean", np.linspace(0, 1, 50), step=2)
frames = [Image.fromarray(np.full((8, 8, 3), i, np.uint8)) for i in (0, 255)]
frames[0].save(folder + "/video.gif", save_all=True, append_images=frames[1:])
frames[0].save(folder + "/picture.png")
logger.log_video("eval/video", folder + "/video.gif")
logger.log_picture("returns", folder + "/picture.png")
logger.log_table("results", [{"method": "bc", "median": "600"}])
logger.shutdown()
"""


def log_everything(folder, kind: str, **env: str) -> subprocess.CompletedProcess:
    clean = {k: v for k, v in os.environ.items() if not k.startswith("WANDB")} | {"HOME": str(folder)} | env
    command = [sys.executable, "-c", EVERYTHING, str(folder), kind]
    return subprocess.run(command, env=clean, capture_output=True, text=True, check=False, timeout=300)


@pytest.mark.parametrize("kind", ["csv", "tensorboard", "wandb"])
def test_each_kind_takes_everything_and_csv_is_always_written(tmp_path, kind):
    if kind != "csv":
        pytest.importorskip(kind)
    done = log_everything(tmp_path, kind)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run" / "scalars" / "loss.csv").read_text().split() == ["1,1.0", "2,0.5"]
    if kind == "tensorboard":
        assert list((tmp_path / "tensorboard").rglob("events.*"))
    if kind == "wandb":
        assert list((tmp_path / "run").rglob("offline-run-*/*.wandb"))


def test_an_unreachable_wandb_falls_back_to_an_offline_run(tmp_path):
    pytest.importorskip("wandb")
    server = {"WANDB_BASE_URL": "http://127.0.0.1:9", "WANDB_API_KEY": "0" * 40}
    done = log_everything(tmp_path, "wandb", **server)
    assert done.returncode == 0, done.stderr
    assert "127.0.0.1:9" in done.stderr and "wandb sync" in done.stderr
    assert list((tmp_path / "run").rglob("offline-run-*/*.wandb"))
    assert (tmp_path / "run" / "scalars" / "loss.csv").exists()


class Refuse(BaseHTTPRequestHandler):
    def do_POST(self):  # noqa: N802
        self.rfile.read(int(self.headers.get("Content-Length", 0)))
        self.send_error(403)

    def log_message(self, *args):
        pass


def test_a_wandb_that_refuses_the_run_falls_back_to_an_offline_run(tmp_path):
    pytest.importorskip("wandb")
    with HTTPServer(("127.0.0.1", 0), Refuse) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        settings = {"WANDB_BASE_URL": f"http://127.0.0.1:{server.server_port}", "WANDB_API_KEY": "0" * 40}
        done = log_everything(tmp_path, "wandb", **settings)
        server.shutdown()
    assert done.returncode == 0, done.stderr
    assert "refused the run" in done.stderr
    assert list((tmp_path / "run").rglob("offline-run-*/*.wandb"))


def test_a_run_opened_again_keeps_its_wandb_id(tmp_path):
    pytest.importorskip("wandb")
    assert log_everything(tmp_path, "wandb").returncode == 0
    first = (tmp_path / "run" / "wandb_id.txt").read_text()
    assert log_everything(tmp_path, "wandb").returncode == 0
    assert (tmp_path / "run" / "wandb_id.txt").read_text() == first
    assert all(path.name.endswith(first) for path in (tmp_path / "run").rglob("offline-run-*"))


def test_a_folder_that_cannot_be_written_is_named_at_once(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file/run.*choose another output folder"):
        make_logger("csv", tmp_path / "file", "run")


def test_an_unknown_kind_and_an_empty_group_are_refused(tmp_path):
    with pytest.raises(ValueError, match="'cvs': choose csv, tensorboard or wandb"):
        make_logger("cvs", tmp_path, "run")
    with pytest.raises(ValueError, match="at least one"):
        LoggerGroup([])


def test_csv_ignores_what_it_cannot_hold(tmp_path):
    logger = make_logger("csv", tmp_path, "run")
    logger.log_histogram("rating", np.ones(3))
    logger.log_table("results", [{"a": 1}])
    logger.shutdown()
    assert not (tmp_path / "run" / "scalars" / "rating.csv").exists()
    assert repr(logger).startswith("LoggerGroup")


class Recorder(LogAdapter):
    """An adapter of a logger that only this test knows."""

    seen: ClassVar[list] = []

    def __getattribute__(self, name):
        if name in ("scalar", "histogram", "picture", "table", "video"):
            return lambda *args: Recorder.seen.append((name, args[0]))
        return super().__getattribute__(name)


def test_every_logger_gets_everything_whatever_its_place(tmp_path, monkeypatch):
    class Own(CSVLogger):
        pass

    monkeypatch.setitem(ADAPTERS, Own, Recorder)
    Recorder.seen = []
    for loggers in ([Own("a", str(tmp_path)), CSVLogger("b", str(tmp_path))], [Own("c", str(tmp_path))]):
        group = LoggerGroup(loggers)
        group.log_scalar("loss", 1.0)
        group.log_histogram("rating", [1.0])
        group.log_picture("returns", "returns.png")
        group.log_video("video", "video.gif")
        group.log_table("results", [{"a": 1}])
    kinds = {"scalar": "loss", "histogram": "rating", "picture": "returns", "video": "video", "table": "results"}
    assert Recorder.seen == 2 * list(kinds.items())


@pytest.mark.parametrize("first", [True, False])
def test_tensorboard_shows_pictures_wherever_it_stands(tmp_path, first):
    pytest.importorskip("tensorboard")
    from PIL import Image
    from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

    frames = [Image.fromarray(np.full((8, 8, 3), i, np.uint8)) for i in (0, 255)]
    frames[0].save(tmp_path / "video.gif", save_all=True, append_images=frames[1:])
    frames[0].save(tmp_path / "picture.png")
    loggers = make_logger("tensorboard", tmp_path, "run").loggers
    group = LoggerGroup(loggers[::-1] if first else loggers)
    group.log_picture("returns", tmp_path / "picture.png", step=2)
    group.log_video("eval/video", tmp_path / "video.gif", step=2)
    group.log_histogram("rating", np.linspace(0, 1, 50), step=2)
    group.log_table("results", [{"method": "bc", "median": 600}])
    group.shutdown()
    (path,) = (tmp_path / "tensorboard" / "run").glob("events.*")
    tags = [value.tag for event in EventFileLoader(str(path)).Load() for value in event.summary.value]
    assert tags == ["returns", "eval/video", "rating", "results/text_summary"]


@pytest.mark.parametrize("rows", [[], [{}], [{"a": 1}, {"b": 1}]])
def test_a_table_without_equal_columns_is_refused(tmp_path, rows):
    with pytest.raises(ValueError, match="rows of equal columns"):
        make_logger("csv", tmp_path, "run").log_table("results", rows)


FULL = OSError(errno.ENOSPC, "No space left on device")


def test_a_full_disk_is_named_by_the_csv_file(tmp_path, monkeypatch):
    logger = make_logger("csv", tmp_path, "run")
    logger.log_scalar("loss", 1.0, step=1)
    file = tmp_path / "run" / "scalars" / "loss.csv"
    (file.parent / "full.csv").symlink_to("/dev/full")
    with pytest.raises(OSError, match=r"cannot write '.*full.csv' .No space left.*choose another output folder"):
        logger.log_scalar("full", 2.0, step=2)

    class Half(io.FileIO):
        """Writes half of a row, as the last bytes of a disk."""

        def write(self, row):
            return super().write(row[: len(row) // 2])

    monkeypatch.setattr(Path, "open", lambda path, mode, buffering=-1: Half(path, mode))
    with pytest.raises(OSError, match=r"cannot write '.*loss.csv' .No space left"):
        logger.log_scalar("loss", 2.0, step=2)
    monkeypatch.undo()
    assert file.read_text() == "1,1.0\n"
    logger.log_scalar("loss", 3.0, step=3)
    assert file.read_text() == "1,1.0\n3,3.0\n"


@pytest.mark.parametrize(
    ("method", "arguments"),
    [
        ("add_scalar", lambda group: group.log_scalar("loss", 1.0, step=1)),
        ("add_histogram", lambda group: group.log_histogram("rating", np.ones(3), step=1)),
        ("add_text", lambda group: group.log_table("results", [{"a": 1}])),
        ("add_hparams", lambda group: group.log_hparams({"q": 0.8})),
    ],
)
def test_a_full_disk_is_named_by_tensorboard_s_folder(tmp_path, monkeypatch, method, arguments):
    pytest.importorskip("tensorboard")
    from torch.utils.tensorboard import SummaryWriter

    def full(*args, **kwargs):
        raise FULL

    group = make_logger("tensorboard", tmp_path, "run")
    monkeypatch.setattr(SummaryWriter, method, full)
    with pytest.raises(OSError, match=r"cannot write '.*tensorboard/run' .No space left.*choose another output folder"):
        arguments(group)
    monkeypatch.undo()
    group.shutdown()
