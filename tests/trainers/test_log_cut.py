"""A run that died after a checkpoint and is resumed logs no step twice, and loses none."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from torchrl_tsallis.trainers import LoggerGroup, make_logger

HERE = Path(__file__).parent
RUN = """
import os, signal, sys
sys.path.insert(0, {here!r})
from train_small import make_trainer
from torchrl_tsallis.trainers import make_logger, resume

folder, kind, die_at, how = sys.argv[1:]
trainer, _ = make_trainer(folder + "/c", checkpoint_every=16, logger=make_logger(kind, folder, "run"))

def die():
    if trainer.collected_frames == int(die_at):
        if how == "interrupt":
            trainer.logger.shutdown()
            raise SystemExit
        os.kill(os.getpid(), signal.SIGKILL)

trainer.register_op("post_steps", die)
resume(trainer)
trainer.train()
trainer.logger.shutdown()
"""


def run(folder: Path, kind: str, die_at: int = 0, how: str = "kill") -> int:
    clean = {k: v for k, v in os.environ.items() if not k.startswith("WANDB")} | {"HOME": str(folder)}
    command = [sys.executable, "-c", RUN.format(here=str(HERE)), str(folder), kind, str(die_at), how]
    return subprocess.run(command, env=clean, check=False, capture_output=True, timeout=300).returncode


def csv_steps(folder: Path) -> list[int]:
    return [int(row.split(",")[0]) for row in (folder / "run" / "scalars" / "ess.csv").read_text().split()]


def tensorboard_steps(folder: Path) -> list[int]:
    """Of the files as they are: TensorBoard itself would leave out what comes twice."""
    from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

    # Names end in the number of the process's file, 9 before 10.
    number = lambda path: (path.name.split(".")[3], int(path.suffix[1:]))  # noqa: E731
    paths = sorted((folder / "tensorboard" / "run").glob("events.*"), key=number)
    events = [event for path in paths for event in EventFileLoader(str(path)).Load() if event.HasField("summary")]
    return [event.step for event in events if any(value.tag == "ess" for value in event.summary.value)]


def wandb_steps(folder: Path) -> list[int]:
    from wandb_rows import wandb_rows

    return [row["step"] for row in wandb_rows(folder / "run") if "ess" in row]


STEPS = {"csv": csv_steps, "tensorboard": tensorboard_steps, "wandb": wandb_steps}


@pytest.mark.parametrize(
    ("kind", "how", "deaths"),
    [("csv", "kill", [28, 36]), ("tensorboard", "kill", [28]), ("wandb", "kill", [28]), ("wandb", "interrupt", [28])],
)
def test_each_step_is_there_once(tmp_path, monkeypatch, kind, how, deaths):
    if kind != "csv":
        pytest.importorskip(kind)
    monkeypatch.syspath_prepend(str(HERE))
    for step in (*deaths, 0):
        assert run(tmp_path, kind, step, how) == (-signal.SIGKILL if step and how == "kill" else 0)
    assert csv_steps(tmp_path) == list(range(4, 41, 4))
    steps = STEPS[kind](tmp_path)
    assert len(set(steps)) == len(steps)
    missing = set(range(4, 41, 4)) - set(steps)
    # A killed process takes along what W&B's own process has not got yet; the CSV file has it.
    assert not missing or (kind == "wandb" and how == "kill")


def test_the_order_of_the_loggers_does_not_matter(tmp_path):
    pytest.importorskip("tensorboard")
    first = make_logger("tensorboard", tmp_path, "run")
    group = LoggerGroup(first.loggers[::-1])
    for step in range(1, 7):
        group.log_scalar("ess", float(step), step=step)
    assert group.last_step() == 6
    group.cut(4)
    assert group.last_step() == 4
    group.log_scalar("ess", 5.0, step=5)
    group.shutdown()
    assert csv_steps(tmp_path) == tensorboard_steps(tmp_path) == [1, 2, 3, 4, 5]


def test_a_row_that_was_cut_off_is_removed(tmp_path):
    logger = make_logger("csv", tmp_path, "run")
    for step in (4, 8):
        logger.log_scalar("ess", 1.0, step=step)
    with (tmp_path / "run" / "scalars" / "ess.csv").open("a") as file:
        file.write("12,0.")
    assert logger.last_step() == 8
    logger.cut(8)
    logger.log_scalar("ess", 3.0, step=12)
    assert (tmp_path / "run" / "scalars" / "ess.csv").read_text() == "4,1.0\n8,1.0\n12,3.0\n"


def test_a_quantity_without_steps_is_counted_on(tmp_path):
    for _ in range(2):
        logger = make_logger("csv", tmp_path, "run")
        logger.log_scalar("eval/median", 1.0)
        logger.shutdown()
    assert (tmp_path / "run" / "scalars" / "eval" / "median.csv").read_text() == "0,1.0\n1,1.0\n"


def test_a_bare_logger_of_torchrl_is_cut_as_well(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(HERE))
    from torchrl.record.loggers.csv import CSVLogger
    from train_small import make_trainer

    trainer, _ = make_trainer(None, logger=CSVLogger("run", str(tmp_path)))
    assert isinstance(trainer.logger, LoggerGroup)
    trainer.train()
    trainer.logger.cut(20)
    assert csv_steps(tmp_path) == [4, 8, 12, 16, 20]
