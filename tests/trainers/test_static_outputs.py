"""A program of CUDA graphs writes each step's losses over those of the last: what is logged must not be written over."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_tsallis import AdaTerm, PeakRating, TsallisBCLoss
from torchrl_tsallis.data import make_replay_buffer
from torchrl_tsallis.modules import make_policy
from torchrl_tsallis.trainers import make_offline_trainer


class Kept:
    """Keeps what was logged."""

    def __init__(self):
        self.rows = []

    def log_scalar(self, name, value, step=None):
        self.rows.append((name, float(value)))

    def log_hparams(self, cfg):
        """Nothing."""


def trained(replayed):
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
    kept = Kept()
    buffer, optimizer = make_replay_buffer(data, batch_size=8), AdaTerm(loss.parameters())
    make_offline_trainer(loss, buffer, optimizer, steps=4, log_every=4, logger=kept, progress=False).train()
    return kept.rows


def test_what_is_logged_is_the_same_with_and_without():
    plain, replayed = trained(False), trained(True)
    assert [name for name, _ in plain] == [name for name, _ in replayed] and len(plain) > 5
    assert dict(replayed) == pytest.approx(dict(plain))
