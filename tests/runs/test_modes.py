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
    modes(file, file.parent / "modes", by="policies", components=3, updates=40, batch_size=32, progress=False)
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


def test_one_policy_of_all_episodes_does_what_the_mode_says(folder, tmp_path):
    found = ModesFolder.open(folder)
    large = [mode["mode"] for mode in found.summary["modes"] if mode["episodes"] > 1]
    run = train(folder, tmp_path / "policy", mode="each", steps=600, batch_size=64, progress=False)
    assert run.settings["data"]["mode"] == "each" and run.settings["data"]["episodes"] == 12
    assert run.settings["data"]["layout"][-1] == ["mode", 2, 2 + len(large)]
    for place, mode in enumerate(large[:2]):
        told = np.eye(len(large), dtype=np.float32)[place]
        sign = 1 if int(found.episodes_of(mode)[0]) % 2 else -1
        action = Run.open(tmp_path / "policy").numpy_policy()(np.concatenate([[1.0, -0.5], told]).astype(np.float32))
        assert action == pytest.approx([sign, -0.5 * sign], abs=0.3)


def test_modes_differ_where_their_operators_do(folder):
    rows = np.genfromtxt(folder / "differences.csv", delimiter=",", names=True)
    found = ModesFolder.open(folder)
    odd = {mode["mode"]: int(found.episodes_of(mode["mode"])[0]) % 2 for mode in found.summary["modes"]}
    assert len(rows) % 20 == 0 and len(rows)
    for pair in {(int(row["mode"]), int(row["other"])) for row in rows}:
        values = [row["difference"] for row in rows if (row["mode"], row["other"]) == pair]
        # Actions are plus and minus standard normal numbers: |2 x| is 2 sqrt(2 / pi) = 1.6 on average.
        assert len(values) == 20 and (np.mean(values) > 1.0) == (odd[pair[0]] != odd[pair[1]])


LABELLED = {
    "npz": lambda path, who: np.savez(path, **arrays(), operator=np.repeat(who, 40)),
    "csv": lambda path, who: path.write_text(
        "episode,obs,act,operator\n" + "".join(f"{k // 10},{k},{k % 7},{who[k // 10]}\n" for k in range(120))
    ),
}


def arrays():
    rng = np.random.default_rng(0)
    return {
        "observations": rng.normal(size=(480, 2)),
        "actions": rng.normal(size=(480, 2)),
        "terminals": np.arange(480) % 40 == 39,
    }


@pytest.mark.parametrize("ending", LABELLED)
def test_labels_of_the_user_are_compared_and_not_used(tmp_path, ending):
    path, who = tmp_path / f"data.{ending}", np.array(["anna", "ben"] * 6)
    LABELLED[ending](path, who)
    options = {"updates": 1, "components": 2, "by": "policies", "progress": False}
    with_labels = modes(path, tmp_path / "with", labels="operator", **options)
    without = modes(path, tmp_path / "without", **options)
    assert (with_labels.mode == without.mode).all() and "labels" not in without.summary
    found = with_labels.summary["labels"]
    assert found["key"] == "operator" and {sum(n.values()) for n in found["episodes"].values()} == {6}
    lines = (tmp_path / "with" / "labels.csv").read_text().splitlines()
    assert lines[0] == "episode,source,label" and [line.rpartition(",")[2] for line in lines[1:]] == who.tolist()


def test_labels_that_are_none_are_refused_before_the_search(tmp_path):
    path = tmp_path / "data.npz"
    np.savez(path, **arrays(), operator=np.arange(480))
    with pytest.raises(KeyError, match="has no 'who', only"):
        modes(path, tmp_path / "out", labels="who", progress=False)
    with pytest.raises(ValueError, match="'operator' of .* within episode '0': a label says one thing of an episode"):
        modes(path, tmp_path / "out", labels="operator", progress=False)
    assert not (tmp_path / "out").exists()


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


def described(pairs, starts, **options):
    pairs = torch.tensor(pairs, dtype=torch.float64)
    return describe(Modes.of_starts(pairs, torch.tensor(starts), **options), [10] * len(pairs))


def test_a_recommendation_says_how_sure_it_is():
    pairs = [[1.0, 1.0, 1.0, 0.0], [1.0, 1.0, 1.0, 0.0], [1.0, 1.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    sure = described(pairs, [[0, 0, 0, 1]] * 2)
    assert sure["sure"] and sure["recommended"] == 0 and sure["sentence"].endswith("Imitate mode 0.")
    half = [[1.0, 0.6, 0.0, 0.0], [0.6, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.5], [0.0, 0.0, 0.5, 1.0]]
    found = described(half, [[0, 0, 1, 1], [0, 1, 0, 1]], always=True)
    assert found["recommended"] == 0 and len(found["reasons"]) == 3 and "with care" in found["sentence"]
    one = described(half, [[0, 0, 1, 1], [0, 1, 0, 1]])
    assert one["sure"] and one["recommended"] == 0 and one["sentence"].startswith("One mode")


def test_what_is_said_of_modes_that_lie_apart():
    def said(*places, **options):
        place = torch.tensor(places).double()
        distances = (place[:, None] - place).abs()
        return describe(Modes.of_distances(distances, **options), [10] * len(places))

    sure = said(0, 1, 2, 3, 100, 101)
    assert sure["sure"] and sure["by"] == "distributions" and sure["sentence"].endswith("Imitate mode 0.")
    equal = said(0, 1, 2, 100, 101, 102)
    assert equal["reasons"] == ["another mode is about as large"] and "with care" in equal["sentence"]
    forced = said(0, 1, 2, 3, 4, 5, 6, least=0.9, count=3)
    assert any(reason.startswith("its episodes are hardly nearer") for reason in forced["reasons"])
    one = said(0, 1, 2, 3, 4, 5, 6, least=0.9)
    assert one["sure"] and one["sentence"].startswith("One mode: no episodes lie apart from the others (0.")


def test_operators_who_are_elsewhere_are_found_from_the_command_line(tmp_path, capsys):
    from torchrl_tsallis.cli import main

    rng, where = np.random.default_rng(0), np.repeat(np.arange(8) % 2, 30)[:, None]
    path = tmp_path / "data.npz"
    observations = where + 0.1 * rng.normal(size=(240, 2))
    np.savez(path, observations=observations, actions=-where + 0.1 * rng.normal(size=(240, 1)),
             terminals=np.arange(240) % 30 == 29, operator=where[:, 0])  # fmt: skip
    words = ["modes", str(path), "--out", str(tmp_path / "out"), "--labels", "operator", "--train.updates", "1"]
    with pytest.raises(SystemExit) as stopped:
        main(words)
    assert stopped.value.code == 0
    assert "2 modes of more than one episode" in capsys.readouterr().out
    found = ModesFolder.open(tmp_path / "out")
    assert found.mode.tolist() == [0, 1] * 4 and found.summary["labels"]["rand_index"] == 1.0
    assert (tmp_path / "out" / "modes.html").read_text().count("lies apart") == 0
