"""Copies whose process is killed or whose disk is full: nothing at the target, an earlier copy as it was."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_tsallis.data.curation import curate
from torchrl_tsallis.data.curators import place


@pytest.fixture
def sources(fixtures, write_npz, write_robomimic, write_v21, tmp_path):
    """A path of each format of which Python itself opens or moves the files."""
    shutil.copytree(fixtures / "lerobot_v3", tmp_path / "v3")
    number = torch.arange(12) // 3
    rows = TensorDict({"observation": torch.zeros(12, 2), "action": torch.zeros(12, 1), "episode": number}, [12])
    rows.memmap(tmp_path / "ted")
    table = tmp_path / "table.csv"
    table.write_text("episode,obs,action\n" + "".join(f"{k // 4},{k},{k}\n" for k in range(16)))
    return {
        "v3": tmp_path / "v3",
        "v21": write_v21(tmp_path / "v21", (3, 5, 4, 2)),
        "ted": tmp_path / "ted",
        "npz": write_npz(padding=np.zeros(10_000)),
        "csv": table,
        "robomimic": write_robomimic(tmp_path / "demo.hdf5"),
    }


def run(jobs, tmp_path):
    (tmp_path / "jobs.json").write_text(json.dumps(jobs))
    script = Path(__file__).with_name("interrupted.py")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", str(script), str(tmp_path / "jobs.json")],
        env=environment, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_a_killed_copy_leaves_no_copy_and_an_earlier_one_whole(sources, write_ratings, hashes, tmp_path):
    # Written by opening several files, or killed at the move to its place.
    moments = {"v3": (3, -1, -2), "v21": (2,), "ted": (-1,), "npz": (1, -1), "csv": (1,), "robomimic": (1, -1)}
    jobs, earlier = [], {}
    for name, numbers in moments.items():
        folder = write_ratings(sources[name], name=f"ratings_{name}")
        for number in numbers:
            for kind in ("over",) if number == -2 else ("new", "over"):
                place_of = tmp_path / f"{name}{number}{kind}"
                place_of.mkdir()
                out = place_of / f"out{sources[name].suffix}"
                if kind == "over":
                    curate(folder, out, keep_list=[0] if name != "robomimic" else ["demo_2"])
                    earlier[str(out)] = hashes(place_of)
                jobs.append([str(folder), str(out), "kill", number])
    before = {name: hashes(path) for name, path in sources.items()}
    for (_, out, _, number), ended in zip(jobs, run(jobs, tmp_path), strict=True):
        out = Path(out)
        assert ended == {"signal": signal.SIGKILL, "error": ""}, out
        left = [item for item in out.parent.iterdir() if "unfinished" in item.name]
        assert len(left) == 1 and left[0].name.startswith(".")
        if str(out) in earlier:
            moved = {
                path.replace(f"{left[0]}/replaced", str(out)): digest for path, digest in hashes(out.parent).items()
            }
            assert moved.items() >= earlier[str(out)].items()
            assert out.exists() == (number != -2)  # between the two moves of a folder both lie in the hidden one
        else:
            assert list(out.parent.iterdir()) == left
    assert {name: hashes(path) for name, path in sources.items()} == before
    # The next one is not disturbed, and says what lies there.
    folder, out = jobs[0][:2]
    done = curate(folder, out, share=0.5)
    assert any("not finished" in note for note in done.notes) and Path(out).is_dir()
    again = curate(folder, out, share=0.25, overwrite=True)
    assert len(again.kept) == 3 and json.loads((Path(out) / "curation.json").read_text())["kept"] == list(again.kept)


def test_a_full_disk_leaves_nothing(sources, write_ratings, hashes, tmp_path):
    jobs = []
    limits = {
        "v3": (0, 3000),
        "v21": (0, 500),
        "npz": (0, 20_000),
        "csv": (0, 20),
        "robomimic": (0, 5000),
        "ted": (0, 40),
    }
    for name, sizes in limits.items():
        folder = write_ratings(sources[name], name=f"ratings_{name}")
        for size in sizes:
            (tmp_path / f"{name}{size}").mkdir()
            jobs.append([str(folder), str(tmp_path / f"{name}{size}" / f"out{sources[name].suffix}"), "full", size])
    before = {name: hashes(path) for name, path in sources.items()}
    for (_, out, _, _), ended in zip(jobs, run(jobs, tmp_path), strict=True):
        assert ended["signal"] == 0 and ended["error"].count("cannot write") == 1 and out in ended["error"], ended
        assert "Traceback" not in ended["error"]
        assert list(Path(out).parent.iterdir()) == []
    assert {name: hashes(path) for name, path in sources.items()} == before


def test_a_memory_mapped_copy_that_does_not_fit_is_refused(sources, write_ratings, tmp_path, monkeypatch):
    usage = shutil._ntuple_diskusage(100, 90, 10)
    monkeypatch.setattr(place.shutil, "disk_usage", lambda path: usage)
    with pytest.raises(OSError, match="cannot write.*bytes are needed, 10 are free"):
        curate(write_ratings(sources["ted"]), tmp_path / "out", share=0.5)
    assert not (tmp_path / "out").exists() and not list(tmp_path.glob(".out*"))
