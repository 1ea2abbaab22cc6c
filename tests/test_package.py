"""What a user of the package meets first: its imports, and the swap of the README in a trainer of TorchRL."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint
from torchrl.objectives import BCLoss
from torchrl.trainers import Trainer

from torchrl_tsallis import CATSoftUpdate, QTuner, TsallisBCLoss
from torchrl_tsallis.data import make_replay_buffer
from torchrl_tsallis.modules import make_policy
from torchrl_tsallis.trainers import OfflineClock, SampleHook

BLOCKED = """
from importlib.machinery import PathFinder
blocked, find = {"gymnasium", "gym", "pybullet", "wandb", "hydra", "omegaconf", "matplotlib"}, PathFinder.find_spec
def find_spec(name, path=None, target=None):
    return None if name.split(".")[0] in blocked else find(name, path, target)
PathFinder.find_spec = find_spec
import torchrl_tsallis, torchrl_tsallis.data, torchrl_tsallis.envs, torchrl_tsallis.evaluation, torchrl_tsallis.modules
print(*torchrl_tsallis.__all__)
"""


def test_the_core_imports_without_the_extras():
    done = subprocess.run([sys.executable, "-c", BLOCKED], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert {"AdaTerm", "CATSoftUpdate", "QTuner", "TsallisBCLoss"} <= set(done.stdout.split())


@pytest.mark.filterwarnings("ignore")  # BCLoss and the legacy defaults of the trainer warn
@pytest.mark.parametrize("method", ["BCLoss", "TsallisBCLoss"])
def test_the_swap_of_the_readme(method):
    torch.manual_seed(0)
    observation = torch.randn(256, 3)
    data = TensorDict({"observation": observation, "action": observation[:, :2].sin()}, [256])
    actor = make_policy(3, 2, hidden=(16,))
    loss = BCLoss(actor) if method == "BCLoss" else TsallisBCLoss(actor)
    trainer = Trainer(
        collector=OfflineClock(40),
        total_frames=40,
        frame_skip=1,
        optim_steps_per_batch=40,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), lr=1e-2),
        progress_bar=False,
        checkpoint=Checkpoint(),
    )
    SampleHook(make_replay_buffer(data, batch_size=64)).register(trainer)
    if method == "TsallisBCLoss":
        updater, tuner = CATSoftUpdate(loss), QTuner(loss)
        trainer.register_op("post_optim", updater.step)
        tuner.register(trainer)
    before = -actor.get_dist(data).log_prob(data["action"]).mean().item()
    trainer.train()
    assert -actor.get_dist(data).log_prob(data["action"]).mean().item() < before - 0.3
    if method == "TsallisBCLoss":
        target = loss.target_actor_network_params
        assert any((a != b).any() for a, b in zip(target.values(True, True), loss.parameters(), strict=True))
        assert tuner.phi.item() != 0.0
