"""The recipe that records page flipping, on a small recording."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

RECIPES = Path(__file__).parents[2] / "recipes"


@pytest.mark.slow
def test_records_loads_and_summarises(monkeypatch, tmp_path):
    for name in ("gymnasium", "pybullet", "hydra", "tqdm", "matplotlib"):
        pytest.importorskip(name)
    monkeypatch.syspath_prepend(str(RECIPES))
    from collect_flip import collect_flips, show, summarise

    settings = {"trajectories": 2, "steps": 100, "workers": 1, "progress": False}
    data, metadata = collect_flips(tmp_path, **settings)
    facts = metadata["trajectories"]
    assert data.shape == (200,) and len(facts) == 2
    assert data["info", "episode"].unique().tolist() == [0, 1]
    assert data["next", "done"].nonzero()[:, 0].tolist() == [99, 199]
    (file,) = tmp_path.glob("*.safetensors")
    written = file.stat().st_mtime_ns
    again, _ = collect_flips(tmp_path, **settings)
    assert file.stat().st_mtime_ns == written
    assert torch.equal(again["action"], data["action"])
    summary = summarise(data, facts)
    assert summary["pairs"] == 200
    assert summary["replayed_pages"] == summary["pages"] and summary["replay_error_metre"] == 0
    show(data[:100], facts[0]["seed"], tmp_path)
    assert (tmp_path / "demonstration.gif").read_bytes()[:3] == b"GIF"
    assert (tmp_path / "demonstration.png").stat().st_size > 10_000
    sys.modules.pop("collect_flip")
