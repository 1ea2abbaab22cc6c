from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from torchrl_tsallis.evaluation.flip_plots import force_over_time  # noqa: E402


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
