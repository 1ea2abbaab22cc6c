from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from torchrl_tsallis.evaluation import returns_grid  # noqa: E402

PANELS = {"clean": {"BC": np.arange(6.0).reshape(3, 2), "proposal": [5.0, 7.0]}, "both": {"proposal": [4.0]}}


def test_writes_png_and_svg_with_tasks_and_methods_and_the_same_twice(tmp_path):
    paths = [tmp_path / "new" / f"figure.{kind}" for kind in ("png", "svg")]
    assert returns_grid(PANELS, paths, title="a title") == paths
    assert paths[0].read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    drawing = paths[1].read_text()
    assert all(f">{text}<" in drawing for text in ("clean", "both", "BC", "proposal", "a title"))
    returns_grid(PANELS, paths, title="a title")
    assert paths[1].read_text() == drawing


@pytest.mark.parametrize(
    ("panels", "name", "message"),
    [
        (PANELS, "figure.pdf", "use .png or .svg"),
        ({}, "figure.png", "nothing to draw"),
        ({"clean": {}}, "figure.png", "nothing to draw"),
        ({"clean": {"BC": [np.nan]}}, "figure.png", "'clean'.*'BC'.*NaN"),
    ],
)
def test_refuses_what_it_cannot_draw(panels, name, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        returns_grid(panels, [tmp_path / name])
    assert list(tmp_path.iterdir()) == []
