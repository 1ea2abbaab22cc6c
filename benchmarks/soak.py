"""Kills trainings at random moments, resumes them, and compares the results bit for bit with unbroken ones.

One command prints the figure::

    python benchmarks/soak.py --kills 200 --seed 0

Single, stacked and recurrent policies, and a sweep of single ones in two worker processes, take turns. Each has a
checkpoint every few steps, so that kills meet its writing too. The last line is the figure; the exit status is 1 if
anything differs, or if a step is logged twice or not at all.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import torch
from tensordict import TensorDict

from torchrl_tsallis import AdaTerm, CATSoftUpdate, PredictiveBCLoss, QTuner, TsallisBCLoss
from torchrl_tsallis._torchrl import logger as torchrl_logger
from torchrl_tsallis.data import make_replay_buffer, make_sequence_buffer, make_stacked_replay_buffer
from torchrl_tsallis.jobs import atomic_path, run_jobs
from torchrl_tsallis.modules import make_policy, make_recurrent_policy
from torchrl_tsallis.trainers import make_logger, make_offline_trainer, resume

KINDS = ("single", "stacked", "recurrent", "sweep")
LOG_EVERY, CHECKPOINT_EVERY = 10, 20
STEPS = {"single": 400, "stacked": 300, "recurrent": 100}


def rows_of(seed: int) -> TensorDict:
    """Demonstrations of a smooth function, ``[64]``."""
    observation = torch.randn(64, 3, generator=torch.Generator().manual_seed(seed))
    return TensorDict({"observation": observation, "action": 0.5 * observation[:, :2].sin()}, [64])


def sequences_of(seed: int, length: int = 16) -> TensorDict:
    """Eight trajectories of them, one after the other."""
    data = torch.cat([rows_of(seed + i) for i in range(2)]).reshape(8, length)
    data["is_init"] = torch.zeros(8, length, 1, dtype=torch.bool)
    data["is_init"][:, 0] = True
    done = data["is_init"].roll(-1, 1)
    following = {"observation": data["observation"].roll(-1, 1), "done": done}
    data["next"] = TensorDict(following | {"terminated": torch.zeros_like(done), "truncated": done}, [8, length])
    return data.reshape(-1)


def train(kind: str, folder: Path, seed: int = 0) -> None:
    """Trains one policy, or stacked ones, from the newest checkpoint on."""
    torch.manual_seed(seed)
    if kind == "stacked":
        loss = TsallisBCLoss([make_policy(3, 2, hidden=(8,)) for _ in range(3)], gamma_mix=[0.0, "adaptive", 1.0])
        buffer = make_stacked_replay_buffer([rows_of(i) for i in range(3)], batch_size=16, seeds=[0, 1, 2])
        tuner = QTuner(loss, tuned=[True, True, False])
    elif kind == "recurrent":
        loss = PredictiveBCLoss(make_recurrent_policy(3, 2, hidden_size=8))
        buffer, tuner = make_sequence_buffer(sequences_of(seed), slice_len=8, num_slices=4, seed=seed), QTuner(loss)
    else:
        loss = TsallisBCLoss(make_policy(3, 2, hidden=(8,)))
        buffer, tuner = make_replay_buffer(rows_of(seed), batch_size=16, seed=seed), QTuner(loss)
    trainer = make_offline_trainer(
        loss,
        buffer,
        AdaTerm(loss.parameters(), batch_dims=int(kind == "stacked")),
        steps=STEPS[kind],
        updater=CATSoftUpdate(loss),
        tuner=tuner,
        logger=make_logger("csv", folder, "log"),
        log_every=LOG_EVERY,
        checkpoint_dir=folder / "checkpoints",
        checkpoint_every=CHECKPOINT_EVERY,
        lr_schedule=partial(torch.optim.lr_scheduler.CosineAnnealingLR, T_max=STEPS[kind]),
        progress=False,
    )
    resume(trainer)
    (folder / "began").touch()
    trainer.train()
    trainer.logger.shutdown()
    digest = hashlib.sha256()
    for name, value in sorted(loss.state_dict().items()):
        digest.update(name.encode() + value.numpy().tobytes())
    digest.update(torch.rand(4).numpy().tobytes())  # the random numbers go on as well
    for path in sorted((folder / "log" / "scalars").rglob("*.csv")):
        steps = [int(row.split(",")[0]) for row in path.read_text().split()]
        if steps != list(range(LOG_EVERY, STEPS[kind] + 1, LOG_EVERY)):
            raise SystemExit(f"{path} has the steps {steps}")
        digest.update(path.read_bytes())
    with atomic_path(folder / "result.json") as path:
        path.write_text(json.dumps(digest.hexdigest()))


def train_one_of_sweep(job: tuple[str, int]) -> None:
    """A job of the sweep; one that is done is not done again."""
    torchrl_logger.setLevel("ERROR")
    folder, seed = Path(job[0]), job[1]
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "result.json").exists():
        train("single", folder, seed)
    (folder.parent / "began").touch()


def run(kind: str, folder: Path) -> None:
    """A training in this process; of the sweep, the jobs are in others."""
    torch.set_num_threads(1)
    torchrl_logger.setLevel("ERROR")
    if kind != "sweep":
        return train(kind, folder)
    bar = {"total": 4, "desc": "sweep", "unit": "job", "progress": False}
    run_jobs(train_one_of_sweep, [(str(folder / f"seed_{i}"), i) for i in range(4)], workers=2, **bar)
    results = [json.loads((folder / f"seed_{i}" / "result.json").read_text()) for i in range(4)]
    with atomic_path(folder / "result.json") as path:
        path.write_text(json.dumps(results))
    return None


def marks(folder: Path) -> list[Path]:
    """What trainings leave once they begin; the folders below come and go while one looks, these do not."""
    return [*folder.glob("began"), *folder.glob("*/began")]


def start(kind: str, folder: Path) -> subprocess.Popen:
    """A process of :func:`run`, which has begun to train when this returns, or has ended."""
    folder.mkdir(parents=True, exist_ok=True)
    for mark in marks(folder):
        mark.unlink()
    command = [sys.executable, __file__, "--run", kind, str(folder)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    while process.poll() is None and not marks(folder):
        time.sleep(0.005)
    return process


def end(process: subprocess.Popen, kind: str) -> None:
    """Waits until the process and its workers have ended."""
    _, err = process.communicate()  # the workers hold the pipe too
    if process.returncode not in (0, -9):
        raise SystemExit(f"{kind} failed:\n{err}")


def main() -> int:
    """Kills, resumes, compares, and prints the figure."""
    parser = argparse.ArgumentParser(description="Kills trainings at random moments and resumes them")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--run", nargs=2, metavar=("KIND", "FOLDER"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.run:
        run(options.run[0], Path(options.run[1]))
        return 0
    rng, root, begun = random.Random(options.seed), Path(tempfile.mkdtemp(prefix="soak-")), time.monotonic()
    whole: dict[str, tuple[str, float]] = {}
    for kind in KINDS:
        process, since = start(kind, root / f"{kind}_whole"), time.monotonic()
        end(process, kind)
        whole[kind] = (root / f"{kind}_whole" / "result.json").read_text(), time.monotonic() - since
        print(f"{kind}: {whole[kind][1]:.1f} s unbroken")
    kills, most, runs, different = dict.fromkeys(KINDS, 0), 0, 0, []
    while sum(kills.values()) < options.kills:
        kind, own = KINDS[runs % len(KINDS)], 0
        folder = root / f"{kind}_{runs}"
        while not (folder / "result.json").exists():
            process = start(kind, folder)
            if sum(kills.values()) < options.kills:
                time.sleep(rng.uniform(0, 0.6 * whole[kind][1]))
                if process.poll() is None:
                    process.kill()
                    own, kills[kind] = own + 1, kills[kind] + 1
            end(process, kind)
        most, runs = max(most, own), runs + 1
        if (folder / "result.json").read_text() != whole[kind][0]:
            different.append(folder)
        else:
            shutil.rmtree(folder)
    told = ", ".join(f"{count} {kind}" for kind, count in kills.items())
    equal = f"{runs - len(different)} of {runs} runs bit for bit as unbroken, weights, random numbers and logs"
    minutes = (time.monotonic() - begun) / 60
    print(f"{sum(kills.values())} random SIGKILLs ({told}; up to {most} a run): {equal}; {minutes:.1f} minutes")
    if different:
        print("different:", *different)
        return 1
    shutil.rmtree(root)
    return 0


if __name__ == "__main__":
    sys.exit(main())
