"""A folder of modes: what is in it, what it says of itself, and what is made of one mode."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from torchrl_tsallis.data.curation import curate
from torchrl_tsallis.data.modes_folder import ModesFolder
from torchrl_tsallis.modes import Modes
from torchrl_tsallis.run import Run, modes, train
from torchrl_tsallis.runs.modes import describe, mode_source


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """12 episodes of 40 steps, by two demonstrators in turns who act by opposite signs."""
    rng = np.random.default_rng(0)
    observations = rng.normal(size=(480, 2)).astype(np.float32)
    sign = np.repeat(np.arange(12) % 2 * 2 - 1, 40)[:, None]
    actions = (sign * observations + 0.05 * rng.normal(size=(480, 2))).astype(np.float32)
    path = tmp_path_factory.mktemp("modes") / "two operators.npz"
    np.savez(path, observations=observations, actions=actions, terminals=np.arange(480) % 40 == 39)
    return path


@pytest.fixture(scope="module")
def folder(file):
    modes(file, file.parent / "modes", components=3, updates=40, batch_size=32, progress=False)
    return file.parent / "modes"


def test_the_folder_says_which_episodes_are_of_one_operator(folder):
    found = ModesFolder.open(folder)
    large = [mode["mode"] for mode in found.summary["modes"] if mode["episodes"] > 1]
    assert large and found.names == tuple(map(str, range(12))) and found.lengths.tolist() == [40] * 12
    for mode in large:
        assert len({int(name) % 2 for name in found.episodes_of(mode)}) == 1
    assert ((found.membership >= 0) & (found.membership <= 1)).all()
    assert sum(mode["steps"] for mode in found.summary["modes"]) == 480


def test_a_copy_of_a_mode_has_its_episodes_as_they_were(file, folder, tmp_path):
    best = ModesFolder.open(folder).summary["recommended"]
    done = curate(folder, tmp_path / "copy.npz", mode=best)
    kept = sorted(map(int, done.kept))
    assert kept == sorted(map(int, ModesFolder.open(folder).episodes_of(best))) and 1 < len(kept) < 12
    rows = np.isin(np.arange(480) // 40, kept)
    np.testing.assert_array_equal(np.load(tmp_path / "copy.npz")["actions"], np.load(file)["actions"][rows])
    assert all(reason.startswith("mode ") for reason in done.dropped.values())


def test_a_policy_of_a_mode_acts_as_its_operator(folder, tmp_path):
    found = ModesFolder.open(folder)
    best = found.summary["recommended"]
    run = train(folder, tmp_path / "policy", mode=best, steps=400, batch_size=64, progress=False)
    sign = 1 if int(found.episodes_of(best)[0]) % 2 else -1
    action = Run.open(tmp_path / "policy").numpy_policy()(np.array([1.0, -0.5], dtype=np.float32))
    assert action == pytest.approx([sign, -0.5 * sign], abs=0.25)
    assert run.settings["data"]["mode"] == str(best) and run.settings["data"]["episodes"] == len(
        found.episodes_of(best)
    )


def test_what_cannot_be_done_is_said(file, folder, tmp_path):
    with pytest.raises(ValueError, match="mode=99 is none of those in .*: choose of 0, "):
        curate(folder, tmp_path / "copy.npz", mode=99)
    with pytest.raises(ValueError, match="exactly one of share, below, keep_list and mode, got share, mode"):
        curate(folder, tmp_path / "copy.npz", mode=0, share=0.1)
    with pytest.raises(ValueError, match="kind 'modes'"):
        curate(folder, tmp_path / "copy.npz", share=0.1)
    with pytest.raises(ValueError, match="mode is one of a folder of modes"):
        train(folder, tmp_path / "policy", mode=0, obs="observations")
    with pytest.raises(FileNotFoundError, match="no folder"):
        mode_source(tmp_path / "nothing", 0)
    with pytest.raises(FileExistsError, match="holds a run"):
        modes(file, folder, updates=1, progress=False)
    assert not list(tmp_path.iterdir())


def test_data_that_have_changed_since_are_refused(file, folder, tmp_path):
    copy = tmp_path / "modes"
    copy.mkdir()
    for name in ("modes.csv", "summary.json"):
        (copy / name).write_bytes((folder / name).read_bytes())
    about = json.loads((folder / "run.json").read_text())
    about["data"]["identity"] = "0" * 64
    (copy / "run.json").write_text(json.dumps(about))
    with pytest.raises(ValueError, match="has changed since its modes were found"):
        mode_source(copy, 0)
    (copy / "modes.csv").write_text("episode,source\n0,a\n")
    with pytest.raises(ValueError, match="has no column 'steps'"):
        ModesFolder.open(copy)


def described(groups, pairs, starts):
    pairs = torch.tensor(pairs, dtype=torch.float64)
    return describe(Modes(groups, pairs, torch.tensor(starts)), [10] * len(pairs))


def test_a_recommendation_says_how_sure_it_is():
    pairs = [[1.0, 1.0, 1.0, 0.0], [1.0, 1.0, 1.0, 0.0], [1.0, 1.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    sure = described(((0, 1, 2), (3,)), pairs, [[0, 0, 0, 1]] * 2)
    assert sure["sure"] and sure["recommended"] == 0 and sure["sentence"].endswith("Imitate mode 0.")
    half = [[1.0, 0.6, 0.0, 0.0], [0.6, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.5], [0.0, 0.0, 0.5, 1.0]]
    found = described(((0, 1), (2, 3)), half, [[0, 0, 1, 1], [0, 1, 0, 1]])
    assert found["recommended"] == 0 and len(found["reasons"]) == 3 and "with care" in found["sentence"]
    one = described(((0, 1, 2, 3),), half, [[0, 0, 1, 1], [0, 1, 0, 1]])
    assert one["sure"] and one["recommended"] == 0 and one["sentence"].startswith("One mode")
