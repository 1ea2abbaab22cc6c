"""The main job on a small slice of real data: end to end, interrupted and resumed, and its messages."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file
from tensordict import TensorDict

from torchrl_tsallis.evaluation import MeanPolicy
from torchrl_tsallis.runs import Run

for package in ("hydra", "pybullet", "matplotlib", "tqdm"):
    pytest.importorskip(package)

RECIPE = Path(__file__).parents[2] / "recipes" / "ant_noise.py"
SMALL = ["data.length=60", "epochs=80", "checkpoint_every=8", "batch_size=256", "evaluation.episodes=2"]
METHODS = ("bc", "q_bc", "proposal", "peak")


def start(folder: Path, *overrides: str) -> subprocess.Popen:
    """Starts the recipe; Ctrl-C reaches it even where these tests are run in the background, which ignores it."""
    command = [sys.executable, str(RECIPE), *SMALL, *overrides]
    environment = os.environ | {"COLUMNS": "80"}
    return subprocess.Popen(
        command, cwd=folder, env=environment, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        start_new_session=True, preexec_fn=partial(signal.signal, signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip


def finish(process: subprocess.Popen) -> tuple[str, str]:
    out, err = process.communicate(timeout=600)
    assert process.returncode == 0, err
    return out, err


def gone(group: int) -> bool:
    for _ in range(100):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.1)
    return False


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unbroken")
    return folder, *finish(start(folder, "log=tensorboard"))


def test_one_command_gives_table_returns_pictures_and_a_video(unbroken):
    folder, out, err = unbroken
    output = folder / "outputs" / "ant_noise"
    with open(output / "returns.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [*rows[0]] == ["method", "task", "seed", "episode", "return"]
    assert [(r["method"], r["episode"]) for r in rows] == [(m, e) for m in METHODS for e in ("0", "1")]
    assert all(method in out for method in METHODS) and "AUROC" in out
    for name in ("returns_both", "schedule_both", "auroc_both", "rating_both_proposal"):
        assert (output / f"{name}.png").stat().st_size > 1000
    for method in METHODS:
        unit = output / "both" / "seed_0" / method
        assert (unit / "rollout.gif").stat().st_size > 1000
        assert len((unit / "scalars" / "loss_tsallis_bc.csv").read_text().split()) == 80
        run = Run.open(unit)
        policy = MeanPolicy.from_actor_state(load_file(unit / "policy.safetensors"))
        np.testing.assert_allclose(run.numpy_policy()(np.ones(28)), policy(np.ones(28)), rtol=1e-6)
        assert run.settings["train"]["epochs"] == 80 and len(run.settings["data"]["identity"]) == 64
        rating = run.rate(TensorDict({"observation": torch.zeros(5, 28), "action": torch.zeros(5, 8)}, [5]))
        assert rating.shape == (5,) and bool((rating == 1).all()) == (method == "bc")
    assert list(output.rglob("events.out.tfevents*"))
    assert "recording: 100%" in err and "training: 100%" in err and "evaluate: 100%" in err


@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGKILL], ids=["Ctrl-C", "kill"])
def test_an_interrupted_job_goes_on_to_the_same_weights(unbroken, tmp_path, sign):
    (tmp_path / "outputs").mkdir()
    (tmp_path / "outputs" / "ant_data").symlink_to(unbroken[0] / "outputs" / "ant_data")
    unit = tmp_path / "outputs" / "ant_noise" / "both" / "seed_0" / "proposal"
    process = start(tmp_path, "method=proposal", "log=wandb")
    deadline = time.monotonic() + 300
    while not list(unit.glob("checkpoints/*")) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    if sign == signal.SIGINT:
        os.killpg(process.pid, sign)  # as Ctrl-C in a terminal does
    else:
        process.kill()
    _, err = process.communicate(timeout=300)
    assert process.returncode == -sign if sign == signal.SIGKILL else "resume=true" in err, err
    assert list(unit.glob("checkpoints/*")) and not (unit / "policy.safetensors").exists()
    assert gone(process.pid), "a worker is left"
    finish(start(tmp_path, "method=proposal", "log=wandb", "resume=true"))
    assert len({path.name.split("-")[-1] for path in unit.rglob("offline-run-*")}) == 1  # one W&B run, continued
    ours, whole = (
        load_file(folder / "outputs/ant_noise/both/seed_0/proposal/policy.safetensors")
        for folder in (tmp_path, unbroken[0])
    )
    assert all((ours[name] == whole[name]).all() for name in whole)
    steps = [int(line.split(",")[0]) for line in (unit / "scalars" / "q.csv").read_text().split()]
    assert steps[-1] == 80 * 7 and len(set(steps)) == 80


def test_resuming_with_other_settings_is_refused(unbroken):
    process = start(unbroken[0], "resume=true", "ratings.tsallis.gamma_min=0.2", "evaluation.episodes=3")
    _, err = process.communicate(timeout=300)
    assert process.returncode == 1 and "was made with other ratings, evaluation" in err


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ({"method": "qbc"}, "no method 'qbc'.*bc, q_bc, q_kl, proposal"),
        ({"task": ["both", "noisy"]}, "no task 'noisy'.*clean, artificial, amateur, both"),
    ],
)
def test_unknown_names_are_refused(override, message, monkeypatch):
    monkeypatch.syspath_prepend(str(RECIPE.parent))
    from ant_noise import units_of
    from omegaconf import OmegaConf

    cfg = OmegaConf.merge(OmegaConf.load(RECIPE.with_suffix(".yaml")), override)
    with pytest.raises(SystemExit, match=message):
        units_of(cfg)


def test_a_dying_training_process_is_named(tmp_path):
    from torchrl_tsallis.jobs import run_jobs

    with pytest.raises(RuntimeError, match="a worker process died while training"):
        run_jobs(os._exit, [1], workers=1, total=1, desc="training", unit="epoch", progress=False)
