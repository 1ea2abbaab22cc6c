"""The page-flipping recipe on a tiny recording: one command, and its report."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

for package in ("hydra", "pybullet", "matplotlib", "tqdm"):
    pytest.importorskip(package)

RECIPES = Path(__file__).parents[2] / "recipes"
SMALL = [
    "data.trajectories=5",
    "data.steps=60",
    "slice_len=30",
    "num_slices=2",
    "epochs=4",
    "validate_every=2",
    "checkpoint_every=2",
    "policy.hidden_size=8",
    "seed=[0]",
    "trials.count=1",
    "workers=1",
]
METHODS = ("bc", "q_bc", "proposal")


@pytest.fixture
def recipes(monkeypatch):
    monkeypatch.syspath_prepend(str(RECIPES))


def test_one_command_gives_raw_results_table_and_pictures(tmp_path):
    command = [sys.executable, str(RECIPES / "page_flip.py"), *SMALL]
    done = subprocess.run(command, cwd=tmp_path, env=os.environ | {"COLUMNS": "80"}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    output = tmp_path / "outputs" / "page_flip"
    with open(output / "page_flip.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [*rows[0]] == ["method", "seed", "trial", "flips", "events", "singles", "multiples", "run", "success"]
    assert [(r["method"], r["seed"], r["trial"]) for r in rows] == [(m, "0", "0") for m in METHODS]
    assert all(method in done.stdout for method in METHODS) and "training: 100%" in done.stderr
    for name in ("mse", "trajectories", "ratings", "schedule"):
        assert (output / f"{name}.png").stat().st_size > 1000
    for method in METHODS:
        unit = output / "seed_0" / method
        assert (output / f"{method}.gif").read_bytes()[:3] == b"GIF"
        errors = [line.split(",") for line in (unit / "scalars" / "eval" / "mse.csv").read_text().split()]
        assert [int(step) for step, _ in errors] == [4, 8] and all(float(value) > 0 for _, value in errors)
        with np.load(unit / "trials.npz") as file:
            assert file["positions_0"].shape == file["forces_0"].shape == (500, 3)
            assert np.linalg.norm(file["forces_0"], axis=1).max() <= 3.3 + 1e-5


def rows_of(counts: dict[str, list[list[int]]]) -> list[dict]:
    names = ("events", "singles", "multiples", "run")
    return [
        {"method": m, "seed": s, "trial": t, "flips": f, "success": int(f >= 3), **dict.fromkeys(names, f)}
        for m, seeds in counts.items()
        for s, trials in enumerate(seeds)
        for t, f in enumerate(trials)
    ]


def test_the_table_counts_by_method_and_seed(recipes, tmp_path):
    from flip_report import read_rows, save_rows, summarise, typical_trial

    rows = rows_of({"bc": [[0, 1, 0], [0, 0, 5]], "proposal": [[4, 4, 1], [3, 0, 4]]})
    save_rows(tmp_path / "r.csv", rows)
    assert read_rows(tmp_path / "r.csv") == rows
    bc, proposal = summarise(rows, tmp_path)
    assert bc["success of continuous flips"] == "1/6" and proposal["success of continuous flips"] == "4/6"
    assert proposal["success of each seed"] == "2/3, 2/3" and proposal["flips"] == "16"
    assert typical_trial(rows, "proposal", 0) == 0 and typical_trial(rows, "proposal", 1) == 0


def test_resuming_with_other_settings_and_unknown_methods_are_refused(recipes, tmp_path):
    import page_flip
    from hydra import compose, initialize_config_dir

    with initialize_config_dir(str(RECIPES), version_base="1.3"):
        cfg = compose("page_flip", [f"output={tmp_path}", "seed=0"])
        other = compose("page_flip", [f"output={tmp_path}", "seed=0", "data.action_unit=1.0"])
        unknown = compose("page_flip", ["method=qbc"])
    units = page_flip.units_of(cfg)
    assert units == [(0, method) for method in METHODS]
    page_flip.check_settings(units, cfg)
    page_flip.check_settings(units, cfg)
    with pytest.raises(SystemExit, match="made with other data"):
        page_flip.check_settings(units, other)
    with pytest.raises(SystemExit, match="no method 'qbc'.*bc, q_bc, proposal"):
        page_flip.units_of(unknown)
