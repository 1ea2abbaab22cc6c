"""A program of CUDA graphs writes the losses of a step over those of the last: averages of both have to hold."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_tsallis import AdaTerm, PeakRating, TsallisBCLoss
from torchrl_tsallis.data import make_replay_buffer
from torchrl_tsallis.modules import make_policy
from torchrl_tsallis.trainers import make_logger, make_offline_trainer


def trained(replayed, folder):
    torch.manual_seed(0)
    data = TensorDict({"observation": torch.randn(32, 3), "action": torch.randn(32, 2)}, [32])
    loss = TsallisBCLoss(make_policy(3, 2), rating=PeakRating())
    if replayed:
        static = {}

        def replay(batch):
            out = loss.forward(batch)
            for key, value in out.items():
                if key.startswith("loss"):
                    continue  # its graph is needed
                static[key] = value.clone() if key not in static else static[key].copy_(value)
                out[key] = static[key]
            return out

        loss._compiled_call_impl = replay
    buffer, optimizer = make_replay_buffer(data, batch_size=8), AdaTerm(loss.parameters())
    logger = make_logger("csv", folder, "run")
    make_offline_trainer(loss, buffer, optimizer, steps=4, log_every=4, logger=logger, progress=False).train()
    files = sorted(folder.rglob("*.csv"))
    return {file.stem: float(file.read_text().split(",")[-1]) for file in files}


def test_what_is_logged_is_the_same_with_and_without(tmp_path):
    plain, replayed = trained(False, tmp_path / "plain"), trained(True, tmp_path / "replayed")
    assert len(plain) > 5 and replayed == pytest.approx(plain)
