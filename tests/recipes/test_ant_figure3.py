"""The recipe of figure 3 on a small slice of real data: killed and started again, and against single runs."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

for package in ("hydra", "pybullet", "matplotlib", "tqdm"):
    pytest.importorskip(package)

RECIPES = Path(__file__).parents[2] / "recipes"
SMALL = ["data.length=60", "epochs=8", "checkpoint_every=2", "evaluation.episodes=3", "workers=0", "progress=false"]
GRID = ["task=[both]", "method=[bc,q_bc_0.8,adaptive_q,proposal]", "seeds=2", "block=1"]


@pytest.fixture
def recipe(monkeypatch):
    monkeypatch.syspath_prepend(str(RECIPES))
    import ant_figure3
    import ant_sweep

    monkeypatch.setattr(ant_sweep, "figure3", lambda cfg: ant_sweep.run(cfg, ant_figure3.wanted_of(cfg)), raising=False)
    return ant_sweep


def config(name: str, folder: Path, *overrides: str):
    from hydra import compose, initialize_config_dir

    with initialize_config_dir(str(RECIPES), version_base="1.3"):
        places = [f"output={folder / 'output'}", f"data.cache={folder / 'data'}"]
        return compose(name, [*SMALL, *places, *overrides])


def start(folder: Path, *overrides: str) -> subprocess.Popen:
    places = ["output=output", "data.cache=data"]
    command = [sys.executable, str(RECIPES / "ant_figure3.py"), *SMALL, *places, *overrides]
    return subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def lines_of(table: Path) -> list[str]:
    return table.read_text().splitlines() if table.exists() else []


@pytest.mark.slow
def test_killed_and_started_again_it_does_everything_once_as_single_runs_do(recipe, tmp_path):
    from ant_noise import train as train_one
    from safetensors.torch import load_file

    output = tmp_path / "output"
    process = start(tmp_path, *GRID)
    deadline = time.monotonic() + 900
    while len(lines_of(output / "returns.csv")) < 5 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)  # while the first unit's policies are evaluated
    process.communicate(timeout=300)
    assert process.returncode == -signal.SIGKILL
    before = lines_of(output / "returns.csv")
    assert 4 <= len(before) < 1 + 24
    policies = output / "own" / "std_0.2" / "both" / "seeds_00-00" / "policies.safetensors"
    trained = policies.stat().st_mtime_ns
    with open(output / "returns.csv", "a") as file:
        file.write("proposal,own,both,0.2,")  # what a kill in the middle of a line leaves

    cfg = config("ant_figure3", tmp_path, *GRID)
    rows = recipe.figure3(cfg)
    assert policies.stat().st_mtime_ns == trained, "trained twice"
    after = lines_of(output / "returns.csv")
    assert after[: len(before)] == before and len(after) == 1 + 24 == 1 + len(set(after[1:]))
    names = ("bc", "q_bc_0.8", "adaptive_q", "proposal")
    keys = [(row["method"], row["std"], row["seed"], row["episode"]) for row in rows]
    assert keys == [(m, 0.2, s, e) for s in (0, 1) for m in names for e in range(3)]

    # A policy of a unit is that of a single run with its seed.
    single = config("ant_noise", tmp_path, "task=both", "q=0.8")
    single.output = str(tmp_path / "single")
    for method, seed, name in (("proposal", 1, "proposal"), ("q_bc", 0, "q_bc_0.8")):
        train_one(("both", seed, method), single)
        alone = load_file(tmp_path / "single" / "both" / f"seed_{seed}" / method / "policy.safetensors")
        together = load_file(
            output / "own" / "std_0.2" / "both" / f"seeds_{seed:02d}-{seed:02d}" / "policies.safetensors"
        )
        for entry, value in alone.items():
            torch.testing.assert_close(together[f"{name}/{seed}/{entry}"], value, rtol=1e-3, atol=1e-5)

    # More episodes are added, and returns do not depend on what was done when; nothing is left to be trained.
    cfg.evaluation.episodes = 4
    more = recipe.figure3(cfg)
    assert [row for row in more if row["episode"] < 3] == rows and len(more) == 32
    assert policies.stat().st_mtime_ns == trained

    with pytest.raises(SystemExit, match=r"made with other epochs: choose another output"):
        recipe.figure3(config("ant_figure3", tmp_path, *GRID, "epochs=6"))
    with pytest.raises(SystemExit, match="no launcher 'slurm'"):
        recipe.figure3(config("ant_figure3", tmp_path, *GRID, "seeds=3", "launcher=slurm"))


@pytest.mark.slow
def test_training_goes_on_from_a_checkpoint_to_the_same_policies(recipe, tmp_path, monkeypatch):
    from safetensors.torch import load_file

    cfg = config("ant_figure3", tmp_path, "task=[clean]", "method=[bc,proposal]", "seeds=1", "evaluation.episodes=1")
    recipe.figure3(cfg)
    whole = load_file(tmp_path / "output" / "own" / "std_0.2" / "clean" / "seeds_00-00" / "policies.safetensors")
    cfg.output = str(tmp_path / "killed")
    epochs = []

    def tick(count: int = 1) -> None:
        epochs.append(count)
        if len(epochs) == 6:
            raise KeyboardInterrupt

    monkeypatch.setattr(recipe, "tick", tick)
    with pytest.raises(SystemExit, match="the same command goes on"):
        recipe.figure3(cfg)
    folder = tmp_path / "killed" / "own" / "std_0.2" / "clean" / "seeds_00-00"
    assert list((folder / "checkpoints").iterdir()) and not (folder / "policies.safetensors").exists()
    epochs.clear()
    monkeypatch.setattr(recipe, "tick", epochs.append)
    monkeypatch.setattr(recipe, "tick", lambda count=1: epochs.append(count))
    recipe.figure3(cfg)
    assert epochs[0] >= 2, "it began anew"
    assert all(torch.equal(value, whole[name]) for name, value in load_file(folder / "policies.safetensors").items())
    assert not (folder / "checkpoints").exists()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning:torch")
def test_a_compiled_loss_trains_the_same_policies(recipe, tmp_path):
    from safetensors.torch import load_file

    small = ["task=[both]", "method=[bc,proposal]", "seeds=1", "epochs=2", "evaluation.episodes=1"]
    policies = {}
    for name in ("null", "{backend: aot_eager}"):  # the path of a C++ compiler or a GPU, without either
        cfg = config("ant_figure3", tmp_path, *small, f"compile={name}")
        cfg.output = str(tmp_path / name[:4])
        recipe.figure3(cfg)
        policies[name] = load_file(
            Path(cfg.output) / "own" / "std_0.2" / "both" / "seeds_00-00" / "policies.safetensors"
        )
    plain, compiled = policies.values()
    for entry, value in plain.items():
        torch.testing.assert_close(compiled[entry], value, rtol=1e-3, atol=1e-5)


def test_a_second_run_in_the_same_folder_is_refused(recipe, tmp_path):
    with (
        recipe.alone_in(tmp_path),
        pytest.raises(SystemExit, match="another run works in"),
        recipe.alone_in(tmp_path),
    ):
        pass


def learned_of(rows: list[dict]) -> list[list[bool]]:
    """By the lines of the table: whether each policy's median is at least half of BC's on the clean task."""
    from statistics import median

    def median_of(**wanted):
        return median(row["return"] for row in rows if all(row[k] == v for k, v in wanted.items()))

    level = median_of(method="bc", task="clean") / 2
    of = {
        (t, m): [median_of(method=m, task=t, seed=s) >= level for s in range(3)]
        for t in ("clean", "both") for m in ("bc", "proposal")
    }  # fmt: skip
    return [*of.values(), *([*of["clean", m], *of["both", m]] for m in ("bc", "proposal"))]


@pytest.mark.slow
def test_one_command_draws_the_figure_from_the_raw_file_alone(recipe, tmp_path):
    from figure3_report import read_raw, save_raw

    generator = torch.Generator().manual_seed(0)
    rows = [
        {"method": m, "trio": "own", "task": t, "std": 0.2, "scale": 1.0, "seed": s, "episode": e}
        | {"return": 1000.0 * (m == "proposal") + 100 * torch.randn((), generator=generator).item()}
        for t in ("clean", "both") for m in ("bc", "proposal") for s in range(3) for e in range(4)
    ]  # fmt: skip
    raw = tmp_path / "raw.csv.gz"
    save_raw(raw, rows)
    first = raw.read_bytes()
    assert [r["return"] for r in read_raw(raw)] == [round(r["return"], 3) for r in rows]
    save_raw(raw, read_raw(raw))
    assert raw.read_bytes() == first
    command = [sys.executable, str(RECIPES / "ant_figure3.py"), "mode=report", f"results={raw}", "pictures=pictures"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=os.environ)
    assert done.returncode == 0, done.stderr
    text = (tmp_path / "pictures" / "figure3.md").read_text()
    assert text in done.stdout
    table = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("|")]
    assert table[0] == ["task", "method", "seeds x episodes", "median", "IQM", "learned", "better than BC"]
    assert [row[:2] for row in table[2:]] == [
        [task, method] for task in ("clean", "both", "all") for method in ("BC (q = 1)", "proposal")
    ]
    assert all(row[2] == "3 x 4" for row in table[2:])
    assert table[3][6] == "1.00 (1.00 to 1.00)" and table[2][6] == "-"
    assert [row[5] for row in table[2:]] == [f"{sum(values)}/{len(values)}" for values in learned_of(rows)]
    value, low, high = (float(x) for x in table[3][3].replace("(", "").replace(")", "").replace("to", "").split())
    assert low <= value <= high and 900 < value < 1100
    assert (tmp_path / "pictures" / "figure3_std0.2.png").stat().st_size > 1000
    assert "<svg" in (tmp_path / "pictures" / "figure3_std0.2.svg").read_text()


@pytest.fixture
def units(monkeypatch):
    monkeypatch.syspath_prepend(str(RECIPES))
    import ant_units

    return ant_units


def test_settings_that_changed_are_refused_and_new_options_are_not(units, tmp_path):
    from common import keep_settings

    file = tmp_path / "settings.json"
    settings = {"loss": {"gamma_min": 0.1, "levels": [1, 2]}, "epochs": 3, "workers": 1}
    keep_settings(file, settings, ["loss", "epochs"])
    keep_settings(file, settings | {"workers": 2}, ["loss", "epochs"])
    keep_settings(file, settings | {"loss": settings["loss"] | {"sync_stats": True}}, ["loss", "epochs"])
    for changed in ({"loss": settings["loss"] | {"gamma_min": 0.2}}, {"loss": {"levels": [1]}}):
        with pytest.raises(SystemExit, match="made with other loss: choose another output, or stop"):
            keep_settings(file, settings | changed, ["loss", "epochs"], "stop")


def row_of(key, episode: int) -> dict:
    return key._asdict() | {"episode": episode, "return": 1.0}


def test_table_loses_only_what_a_kill_cut_off(units, tmp_path):
    table = units.ReturnsTable(tmp_path / "returns.csv")
    rows = [row_of(units.Key("bc", "both", 0.25, 3), episode) for episode in range(3)]
    table.append(rows)
    content = table.path.read_bytes()
    for size in range(len(content)):
        table.path.write_bytes(content[:size])
        kept = table.read()
        assert kept == rows[: len(kept)] and len(kept) == max(content[:size].count(b"\n") - 1, 0)
        table.append(rows[len(kept) :])
        assert table.path.read_bytes() == content
    table.append(rows)  # a row that is there twice counts once
    assert table.read() == rows and table.counts() == {units.Key("bc", "both", 0.25, 3): 3}
    with open(table.path, newline="") as file:
        assert tuple(next(csv.reader(file))) == units.COLUMNS


def test_no_policy_is_in_two_units_and_none_is_left_out(units, tmp_path):
    table = units.ReturnsTable(tmp_path / "returns.csv")

    def wanted(seeds, methods=("bc", "proposal")):
        return [units.Key(m, "both", 0.2, s) for s in seeds for m in methods]

    first = units.plan(wanted(range(3)), table, tmp_path, episodes=2, block=2)
    assert [unit.folder.name for unit in first] == ["seeds_00-01", "seeds_02-02"]
    (first[0].folder / "policies.safetensors").touch()  # begun: it stays as it is
    assert first[0].begun and not first[1].begun
    table.append([row_of(key, 0) for key in wanted([0])])  # half of its episodes
    table.append([row_of(key, episode) for key in wanted([1]) for episode in range(2)])
    second = units.plan(wanted(range(5), ("bc", "proposal", "q_bc_0.8")), table, tmp_path, episodes=2, block=2)
    assert second[0] == first[0]
    new = [key for unit in second[1:] for key in unit.keys]
    assert sorted(new) == sorted(wanted([2, 3, 4]) + wanted(range(5), ("q_bc_0.8",)))
    assert len({unit.folder for unit in second}) == len(second)
    for unit in second:
        (unit.folder / "policies.safetensors").touch()
        missing = set(unit.keys) - set(table.counts())
        table.append([row_of(key, episode) for key in unit.keys for episode in range(2) if key in missing])
    table.append([row_of(key, 1) for key in wanted([0])])
    assert units.plan(wanted(range(5), ("bc", "proposal", "q_bc_0.8")), table, tmp_path, episodes=2, block=2) == []
