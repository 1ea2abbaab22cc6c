from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from torchrl_tsallis.evaluation.flip_plots import (  # noqa: E402
    error_curves,
    flip_trajectories,
    force_over_time,
    ratings_over_time,
)


def test_writes_a_png(tmp_path):
    faults = {"missed": np.arange(9) > 4, "hesitation": np.zeros(9, dtype=bool)}
    path = force_over_time(
        np.ones((9, 3)) * 2, tmp_path / "f.png", angles=np.zeros((9, 10)), flips=[3], faults=faults, title="t"
    )
    assert path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


@pytest.mark.parametrize(
    ("forces", "angles", "faults", "message"),
    [
        (np.ones((9, 2)), np.zeros((9, 10)), {}, "needed are forces"),
        (np.ones((9, 3)), np.zeros((8, 10)), {}, "needed are forces"),
        (np.full((9, 3), np.nan), np.zeros((9, 10)), {}, "finite"),
        (np.ones((9, 3)), np.zeros((9, 10)), {"missed": [True]}, "'missed'"),
    ],
)
def test_refuses(forces, angles, faults, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        force_over_time(forces, tmp_path / "f.png", angles=angles, faults=faults)


def test_the_figures_of_the_results_are_written(tmp_path):
    steps, trial = np.arange(1, 4), (np.zeros((20, 3)), np.ones((20, 3)))
    paths = [
        error_curves({"bc": (steps, np.ones((3, 3))), "one": (steps, np.ones((1, 3)))}, tmp_path / "mse.png"),
        flip_trajectories({"bc": trial, "proposal": trial}, tmp_path / "paths.png"),
        ratings_over_time({"bc": np.ones(9)}, tmp_path / "r.png", faults={"missed": np.arange(9) > 4}),
    ]
    assert all(path.read_bytes()[:4] == b"\x89PNG" for path in paths)


@pytest.mark.parametrize(
    ("draw", "data", "message"),
    [
        (error_curves, {}, "nothing"),
        (error_curves, {"bc": ([1, 2], np.ones((3, 3)))}, "'bc'.*3, 3.*2 epochs"),
        (error_curves, {"bc": ([1], [[np.nan]])}, "NaN"),
        (flip_trajectories, {}, "nothing"),
        (flip_trajectories, {"bc": (np.zeros((4, 3)), np.zeros((5, 3)))}, "'bc'.*4, 3"),
        (flip_trajectories, {"bc": (np.full((4, 3), np.nan), np.zeros((4, 3)))}, "finite"),
        (ratings_over_time, {}, "nothing"),
        (ratings_over_time, {"a": np.ones(3), "b": np.ones(4)}, "'b' has shape"),
    ],
)
def test_figures_refuse(draw, data, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        draw(data, tmp_path / "f.png")
