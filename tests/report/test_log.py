"""Ratings in loggers."""

from __future__ import annotations

import pytest
from torchrl.record.loggers.csv import CSVLogger

from torchrl_tsallis.report import log_ratings


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


def test_csv_gets_nothing(write_folder, tmp_path):
    log_ratings(write_folder(), CSVLogger("run", log_dir=str(tmp_path / "logs")))
    assert not [file for file in (tmp_path / "logs").rglob("*") if file.is_file()]
