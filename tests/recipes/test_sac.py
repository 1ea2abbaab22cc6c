"""The experts' loss is TorchRL's."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

RECIPES = Path(__file__).parents[2] / "recipes"


def test_the_written_out_loss_has_the_values_and_gradients_of_sac_loss(monkeypatch):
    pytest.importorskip("omegaconf")
    from omegaconf import OmegaConf

    monkeypatch.syspath_prepend(str(RECIPES))
    from sac import make_loss, written_out

    cfg = OmegaConf.create({"actor_cells": [8, 8], "critic_cells": [8, 8], "gamma": 0.9, "target_entropy": -2.0})
    torch.manual_seed(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # TorchRL misses a target updater
        loss, _ = make_loss(cfg, 3, 2)
    SoftUpdate(loss, tau=0.1)
    batch = TensorDict({"observation": torch.randn(32, 3), "action": torch.rand(32, 2) * 2 - 1}, [32])
    batch["next"] = {"observation": torch.randn(32, 3), "reward": torch.randn(32, 1)}
    batch["next", "terminated"] = batch["next", "done"] = torch.rand(32, 1) < 0.3

    def total_of_torchrl():
        out = loss(batch)
        return out["loss_qvalue"] + out["loss_actor"] + out["loss_alpha"]

    def total_written_out():
        keys = ["observation", "action", ("next", "observation"), ("next", "reward"), ("next", "terminated")]
        return written_out(loss, 0.9, -2.0)(*(batch[key] for key in keys))

    results = []
    for total in (total_of_torchrl, total_written_out):
        torch.manual_seed(1)
        value = total()
        loss.zero_grad()
        value.backward()
        results.append([value.detach(), *(p.grad.clone() for p in loss.parameters())])
    for mine, theirs in zip(*results, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-5)
    assert len(results[0]) > 10
    sys.modules.pop("sac")
