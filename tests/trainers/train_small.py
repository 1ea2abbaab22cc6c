"""A small training in a process of its own: ``train_small.py FOLDER RESULT [DIE_AT_STEP]``; it resumes by itself."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import torch
from tensordict import TensorDict

from torchrl_tsallis import AdaTerm, CATSoftUpdate, QTuner, TsallisBCLoss
from torchrl_tsallis.data import make_replay_buffer
from torchrl_tsallis.modules import make_policy
from torchrl_tsallis.trainers import make_offline_trainer, resume


def make_data(samples: int = 64) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    observation = torch.randn(samples, 3, generator=generator)
    return TensorDict({"observation": observation, "action": 0.5 * observation[:, :2].sin()}, [samples])


def make_trainer(folder: str | Path | None, *, hidden: int = 8, samples: int = 64, **kwargs):
    """A trainer of the whole method, and its loss."""
    torch.manual_seed(1)
    loss = TsallisBCLoss(make_policy(3, 2, hidden=(hidden,)))
    settings = {"steps": 40, "log_every": 4, "checkpoint_dir": folder, "checkpoint_every": 8, "progress": False}
    trainer = make_offline_trainer(
        loss,
        make_replay_buffer(make_data(samples), batch_size=16, seed=2),
        AdaTerm(loss.parameters()),
        updater=CATSoftUpdate(loss),
        tuner=QTuner(loss),
        **(settings | kwargs),
    )
    return trainer, loss


def main(folder: str, result: str, die_at: int | None = None) -> None:
    trainer, loss = make_trainer(folder)

    def die() -> None:
        if die_at is not None and trainer.collected_frames >= die_at:
            os.kill(os.getpid(), signal.SIGKILL)

    trainer.register_op("post_steps", die)
    if resume(trainer) < trainer.total_frames:
        trainer.train()
    torch.save({**loss.state_dict(), "random": torch.rand(3)}, result)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], *(int(value) for value in sys.argv[3:]))
