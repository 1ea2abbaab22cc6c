from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from torchrl_tsallis.evaluation.plots import (  # noqa: E402
    auroc_bars,
    rating_histogram,
    return_by_method,
    schedule,
)

CURVE = {"step": [0, 1, 2], "q": [0.8, 0.85, 0.9], "gamma": [0.1, 0.1, 0.2]}
CASES = [
    (return_by_method, {"BC": np.arange(6.0).reshape(2, 3), "q": [5.0]}),
    (rating_histogram, {"clean": [1.0, 0.5], "noisy": [0.0, 1e-30]}),
    (rating_histogram, {"clean": [0.0, 0.0]}),
    (schedule, {"proposal": CURVE, "fixed": {"step": [0], "gamma": [0.5]}}),
    (auroc_bars, {"BC": 0.5}),
]


@pytest.mark.parametrize(("function", "data"), CASES)
def test_writes_a_png(function, data, tmp_path):
    path = tmp_path / "new" / "figure.png"
    assert function(data, path, title="t") == path
    assert path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert [p.name for p in path.parent.iterdir()] == ["figure.png"]


@pytest.mark.parametrize(
    ("function", "data", "message"),
    [
        (return_by_method, {"BC": []}, r"returns\['BC'\] is empty"),
        (return_by_method, {}, "nothing to draw"),
        (rating_histogram, {"clean": [-1.0]}, "not its logarithm"),
        (schedule, {"a": {"q": [1.0]}}, "no 'step'"),
        (schedule, {"a": {"step": [0], "q": [1.0, 1.0]}}, "2 q, 1 steps"),
        (auroc_bars, {"BC": float("nan")}, "not an AUROC"),
    ],
)
def test_bad_data_leaves_no_file(function, data, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        function(data, tmp_path / "figure.png")
    assert not list(tmp_path.iterdir())
