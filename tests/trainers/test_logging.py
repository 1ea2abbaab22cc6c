"""Loggers: CSV always; TensorBoard and W&B beside it, W&B with neither account nor network."""

from __future__ import annotations

import os
import subprocess
import sys
from http.server import BaseHTTPRequestHandler, HTTPServer
from threading import Thread

import numpy as np
import pytest

from torchrl_tsallis.trainers import LoggerGroup, make_logger

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
