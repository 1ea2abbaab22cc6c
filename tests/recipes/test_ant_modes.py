"""The recipes on modes on small slices of real data: stopped and started again, and their tables from the files."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

for package in ("hydra", "pybullet", "matplotlib", "tqdm"):
    pytest.importorskip(package)

RECIPES = Path(__file__).parents[2] / "recipes"
SMALL = ["data.length=40", "updates=1", "steps=10", "evaluation.episodes=1", "search.starts=2", "search.components=2",
         "by=policies", "part=[gaits]", "cells.gaits.std=0.2",
          "seeds=[1,2]", "workers=0", "progress=false"]  # fmt: skip


@pytest.fixture
def run(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(RECIPES))
    from hydra import compose, initialize_config_dir

    def compose_and_run(name, *overrides):
        module = __import__(name)
        with initialize_config_dir(str(RECIPES), version_base="1.3"):
            cfg = compose(name, [*overrides, f"output={tmp_path / name}"])
        module.main.__wrapped__(cfg)

    return compose_and_run


def rows_of(path):
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_cells_that_were_searched_elsewhere_walk_here_and_nothing_is_done_twice(run, tmp_path):
    cache = f"data.cache={tmp_path / 'data'}"
    run("ant_modes", *SMALL, cache, "mode=train", "block=2")
    cells = tmp_path / "ant_modes" / "cells" / "mixtures" / "other_gait" / "std_0.2" / "both"
    before = {path.name: path.stat().st_mtime_ns for path in cells.iterdir()}
    assert sorted(name.partition(".")[0] for name in before) == ["modes_1", "modes_2", "policies_1", "policies_2"]
    run("ant_modes", *SMALL, cache)
    assert {name: (cells / name).stat().st_mtime_ns for name in before} == before, "done twice"
    returns, assigned = (rows_of(tmp_path / "ant_modes" / f"{name}.csv") for name in ("modes", "modes_assignments"))
    assert {row["seed"] for row in returns} == {"1", "2"} and {row["method"] for row in returns} == {"mixtures"}
    assert [sum(row["seed"] == seed for row in assigned) for seed in ("1", "2")] == [30, 30]
    assert {row["demonstrator"] for row in assigned} == {"0", "1", "2", "3"}
    for seed in ("1", "2"):
        best = {row["component"] for row in returns if row["seed"] == seed and row["recommended"] == "1"}
        assert len(best) == 1
    table = (tmp_path / "ant_modes" / "modes.md").read_text()
    run("ant_modes", *SMALL, "mode=report")
    assert (tmp_path / "ant_modes" / "modes.md").read_text() == table
    assert (tmp_path / "ant_modes" / "modes.png").read_bytes()[:4] == b"\x89PNG"


def test_a_mode_or_part_that_there_is_not_is_refused_before_anything_is_made(run, tmp_path):
    with pytest.raises(SystemExit, match="no mode 'walk': choose run, train, film or report"):
        run("ant_modes", "mode=walk")
    with pytest.raises(SystemExit, match="no cells 'gait': choose of gaits, own, rest"):
        run("ant_modes", "part=[gait]")
    with pytest.raises(SystemExit, match="there is no .*modes.csv"):
        run("ant_modes", "mode=report")
    assert not (tmp_path / "ant_modes").exists()


def test_two_operators_who_flip_pages_are_recorded_searched_and_compared(run, tmp_path, capsys):
    small = ["trajectories=3", "seeds=[1]", "workers=0", "progress=false"]
    run("flip_modes", *small)
    rows = rows_of(tmp_path / "flip_modes" / "flip_modes.csv")
    assert [row["operator"] for row in rows] == ["calm", "quick"] * 12
    assert {row["pair"] for row in rows} == {"keep_habits", "drawn_anew"} and {row["told"] for row in rows} == {"", "2"}
    assert len({row["tremor"] for row in rows if row["pair"] == "drawn_anew"}) == 6
    assert len({row["tremor"] for row in rows if row["pair"] == "keep_habits"}) == 2
    assert all(int(row["pages"]) > 0 for row in rows)
    assert "calm" in (tmp_path / "flip_modes" / "flip_modes.md").read_text()
    assert "Rand index" in capsys.readouterr().out
    import flip_modes

    # Means 2 and 6 within, deviations of 1: 4 of 20 in all, times 3 degrees of freedom over 2.
    assert flip_modes.explained([1.0, 3.0, 5.0, 7.0], np.array([0, 0, 1, 1])) == pytest.approx(1 - 4 / 20 * 3 / 2)
