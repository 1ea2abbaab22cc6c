"""A full or read-only disk gives one error with path and way out, and leaves a good file as it was."""

from __future__ import annotations

import resource
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from torchrl_tsallis.evaluation import auroc_bars, return_by_method, returns_grid, schedule
from torchrl_tsallis.evaluation.flip_plots import error_curves, force_over_time
from torchrl_tsallis.evaluation.video_files import write_gif, write_mp4

RNG = np.random.default_rng(0)
FRAMES = [RNG.integers(0, 255, (120, 160, 3), dtype=np.uint8) for _ in range(8)]
WRITERS = {
    "gif": ("PIL", lambda path: write_gif(FRAMES, path, 10)),
    "mp4": ("imageio_ffmpeg", lambda path: write_mp4(FRAMES, path, 10)),
    "return.png": ("matplotlib", lambda path: return_by_method({"BC": np.arange(30.0)}, path)),
    "auroc.png": ("matplotlib", lambda path: auroc_bars({"BC": 0.5, "q": 0.7}, path)),
    "schedule.png": ("matplotlib", lambda path: schedule({"q": {"step": [0, 1], "q": [0.8, 0.9]}}, path)),
    "errors.png": ("matplotlib", lambda path: error_curves({"BC": ([1, 2], [[0.3, 0.2], [0.4, 0.1]])}, path)),
    "force.png": ("matplotlib", lambda path: force_over_time(np.ones((9, 3)), path, angles=np.zeros((9, 2)))),
    "grid.png": ("matplotlib", lambda path: returns_grid({"clean": {"BC": np.arange(9.0)}}, [path])),
    "grid.svg": ("matplotlib", lambda path: returns_grid({"clean": {"BC": np.arange(9.0)}}, [path])),
}


@contextmanager
def little_space(size=2000):
    """No file of this process or its children grows beyond a size: writing more fails, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_leaves_the_good_file(name, tmp_path):
    module, write = WRITERS[name]
    pytest.importorskip(module)
    path = tmp_path / f"a.{name.rpartition('.')[2]}"
    write(path)  # fonts and codecs are loaded, and cached, before
    good = path.read_bytes()
    assert len(good) > 2000
    with little_space(), pytest.raises(OSError, match=f"cannot write .*{path.name}.*free space.*another output folder"):
        write(path)
    assert path.read_bytes() == good
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", WRITERS)
def test_a_place_that_cannot_be_written_is_named(name, tmp_path):
    module, write = WRITERS[name]
    pytest.importorskip(module)
    suffix = name.rpartition(".")[2]
    (tmp_path / "file").write_text("")
    (tmp_path / f"folder.{suffix}").mkdir()
    for path in (tmp_path / "file" / f"a.{suffix}", tmp_path / f"folder.{suffix}"):
        with pytest.raises(OSError, match=f"cannot write '.*{path.name}'.*permissions"):
            write(path)
    assert sorted(part.name for part in tmp_path.iterdir()) == ["file", f"folder.{suffix}"]


ROW = {
    "method": "bc",
    "trio": "own",
    "task": "both",
    "std": 0.2,
    "scale": 1.0,
    "seed": 0,
    "episode": 0,
    "return": 1.5,
    "trial": 0,
}
FLIPS = dict.fromkeys(("flips", "events", "singles", "multiples", "run", "success"), 1)
ROWS = [{**ROW, "episode": i} for i in range(2000)]


@pytest.fixture(params=["returns", "growing returns", "raw returns", "trials"])
def write_table(request, monkeypatch):
    """A recipe's writer of raw results, and the error's way out."""
    for package in ("hydra", "matplotlib"):
        pytest.importorskip(package)
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "recipes"))
    import ant_report
    import ant_units
    import figure3_report
    import flip_report

    counts = [{name: row[name] for name in ("method", "seed", "trial")} | FLIPS for row in ROWS]
    return {
        "returns": (lambda path: ant_report.save_returns(path, ROWS), "another output folder"),
        "growing returns": (lambda path: ant_units.ReturnsTable(path).append(ROWS), "complete rows are kept"),
        "raw returns": (lambda path: figure3_report.save_raw(path, ROWS), "another output folder"),
        "trials": (lambda path: flip_report.save_rows(path, counts), "another output folder"),
    }[request.param]


def test_a_table_of_results_on_a_full_or_closed_disk_keeps_what_it_has(write_table, tmp_path):
    write, way_out = write_table
    path = tmp_path / "table.csv"
    write(path)
    good = path.read_bytes()
    with little_space(), pytest.raises(OSError, match=f"cannot write '.*table.csv'.*free space.*{way_out}"):
        write(path)
    assert path.read_bytes().startswith(good)  # the growing one may have rows more
    assert list(tmp_path.iterdir()) == [path]
    for place in (path / "table.csv", tmp_path):
        with pytest.raises(OSError, match="cannot write .*permissions"):
            write(place)


def test_a_figure_is_a_png_or_refused(tmp_path):
    pytest.importorskip("matplotlib")
    for suffix in ("pdf", "jpg", "svg"):
        with pytest.raises(ValueError, match=f"cannot write .*a.{suffix}.*use .png"):
            auroc_bars({"BC": 0.5}, tmp_path / f"a.{suffix}")
    assert not list(tmp_path.iterdir())
