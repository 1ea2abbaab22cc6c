"""Ratings in loggers."""

from __future__ import annotations

import json

import pytest
from torchrl.record.loggers.csv import CSVLogger

from torchrl_tsallis.report import log_ratings
from torchrl_tsallis.runs.tables import SIGNALS


class Wandb:
    """What the adapter calls of TorchRL's W&B logger."""

    def __init__(self) -> None:
        self.logged, self.experiment, self.log_dir = {}, self, None

    def log(self, entries) -> None:
        self.logged |= entries

    def log_histogram(self, name, values, step, bins) -> None:
        self.logged[name] = values


def test_tensorboard_gets_a_table_and_a_histogram(write_folder, tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    from torchrl.record.loggers.tensorboard import TensorboardLogger

    names = [*(f"demo_{k}" for k in range(10)), "a|b", "c\nd"]
    logger = TensorboardLogger("run", log_dir=str(tmp_path / "logs"))
    log_ratings(write_folder(names=names), logger)
    logger.experiment.close()
    events = EventAccumulator(str(logger.log_dir), size_guidance={"histograms": 0}).Reload()
    assert events.Tags()["histograms"] == ["ratings/surprise"]
    counted = sum(events.Histograms("ratings/surprise")[0].histogram_value.bucket)
    assert counted > 12 * 20
    (text,) = (tag for tag in events.Tags()["tensors"] if "episodes" in tag)
    lines = events.Tensors(text)[0].tensor_proto.string_val[0].decode().split("\n")
    assert len(lines) == 2 + 12 and lines[0].startswith("|rank|episode|surprise|")
    assert any("|a\\|b|" in line for line in lines) and any("|c d|" in line for line in lines)


def test_wandb_gets_a_table_and_a_histogram(write_folder, monkeypatch):
    wandb = pytest.importorskip("wandb")
    from torchrl_tsallis.trainers import log_adapters

    logger = Wandb()
    monkeypatch.setitem(log_adapters.ADAPTERS, Wandb, log_adapters.WandbAdapter)
    log_ratings(write_folder(), logger, name="door")
    table = logger.logged["door/episodes"]
    assert isinstance(table, wandb.Table) and [row[0] for row in table.data] == list(range(1, 13))
    assert {row[1] for row in table.data[:3]} == {"demo_9", "demo_10", "demo_11"}
    assert logger.logged["door/surprise"].max() > 4
    named = ["rank", "episode", "surprise", "low", "high", "share over 3 decades", "worst step"]
    assert table.columns == [*named, "steps", *SIGNALS]
    first = dict(zip(table.columns, table.data[0], strict=True))
    assert first["high"] - first["low"] == pytest.approx(0.6, abs=1e-3) and first["low"] < first["surprise"]


def test_a_number_that_is_not_there_is_left_empty(write_folder, monkeypatch):
    pytest.importorskip("wandb")
    from torchrl_tsallis.trainers import log_adapters

    folder, logger = write_folder(), Wandb()
    lines = (folder / "episodes.csv").read_text().splitlines()
    cells = lines[-1].split(",")
    lines[-1] = ",".join([*cells[:4], "", "", *cells[6:]])  # one seed has no interval
    (folder / "episodes.csv").write_text("\n".join(lines) + "\n")
    monkeypatch.setitem(log_adapters.ADAPTERS, Wandb, log_adapters.WandbAdapter)
    log_ratings(folder, logger)
    (row,) = (row for row in logger.logged["ratings/episodes"].data if row[1] == "demo_11")
    assert row[3:5] == [None, None] and row[2] > 4


@pytest.mark.parametrize("kind", ["tensorboard", "wandb"])
def test_each_logger_of_a_group_gets_both(kind, write_folder, tmp_path, monkeypatch):
    pytest.importorskip(kind)
    from torchrl_tsallis.trainers import make_logger

    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    logger = make_logger(kind, tmp_path / "logs", "door")
    log_ratings(write_folder(), logger)
    logger.shutdown()
    if kind == "wandb":
        (file,) = (tmp_path / "logs").rglob("*.table.json")
        assert len(json.loads(file.read_text())["data"]) == 12
    else:
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

        tags = EventAccumulator(str(tmp_path / "logs/tensorboard/door")).Reload().Tags()
        assert tags["histograms"] == ["ratings/surprise"] and tags["tensors"]


def test_csv_gets_nothing(write_folder, tmp_path):
    log_ratings(write_folder(), CSVLogger("run", log_dir=str(tmp_path / "logs")))
    assert not [file for file in (tmp_path / "logs").rglob("*") if file.is_file()]
