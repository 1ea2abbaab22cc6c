"""The command line: what it answers, its exit codes, and that every command is one call."""

from __future__ import annotations

import json

import numpy as np
import pytest

pytest.importorskip("tyro")

from torchrl_tsallis.cli import main


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """12 episodes of 40 steps, of which one has random actions."""
    rng = np.random.default_rng(0)
    observations = rng.normal(size=(480, 3)).astype(np.float32)
    actions = np.tanh(observations[:, :2]) + 0.05 * rng.normal(size=(480, 2))
    actions[80:120] = rng.normal(size=(40, 2))
    path = tmp_path_factory.mktemp("cli") / "demonstrations.npz"
    ends = np.arange(480) % 40 == 39
    np.savez(path, observations=observations, actions=actions.astype(np.float32), terminals=ends)
    return path


def call(capsys, *words):
    """Exit code, answer and errors of a command."""
    with pytest.raises(SystemExit) as stop:
        main([str(word) for word in words])
    out, err = capsys.readouterr()
    return stop.value.code, out, err


@pytest.fixture(scope="module")
def ratings(file):
    with pytest.raises(SystemExit) as stop:
        main(["rate", str(file), "--out", str(file.parent / "ratings"), "--train.steps", "200", "--json"])
    assert not stop.value.code
    return file.parent / "ratings"


def test_info_says_what_is_in_a_file(file, capsys):
    code, out, _ = call(capsys, "info", file)
    assert not code and "12 episodes, 480 steps" in out and "actions: float32 [2], action" in out
    code, out, _ = call(capsys, "info", file, "--json")
    assert not code and json.loads(out)["steps"] == 480


def test_a_rating_becomes_a_report_a_copy_a_policy_and_onnx(file, ratings, capsys, tmp_path):
    assert not call(capsys, "report", ratings)[0]
    assert "12 episodes" in (ratings / "report.html").read_text()
    copy = tmp_path / "curated.npz"
    code, out, _ = call(capsys, "curate", ratings, "--out", copy, "--share", "0.1", "--dry-run")
    assert not code and not copy.exists() and "\n  2: surprise" in out
    assert not call(capsys, "curate", ratings, "--out", copy, "--share", "0.1")[0]
    assert np.load(copy)["actions"].shape == (440, 2)
    np.testing.assert_array_equal(np.load(copy)["actions"], np.delete(np.load(file)["actions"], np.s_[80:120], axis=0))
    code, out, err = call(capsys, "train", copy, "--out", tmp_path / "policy", "--train.steps", "20", "--json")
    assert not code and not err and json.loads(out)["data"]["steps"] == 440
    pytest.importorskip("onnxscript")
    assert not call(capsys, "export", tmp_path / "policy", "--onnx", tmp_path / "policy.onnx")[0]
    assert (tmp_path / "policy.onnx").stat().st_size > 1000


def test_curate_takes_a_list_of_the_episodes_to_keep(ratings, capsys, tmp_path):
    (tmp_path / "keep.json").write_text("[0, 1, 5]")
    assert not call(capsys, "curate", ratings, "--out", tmp_path / "a.npz", "--list", tmp_path / "keep.json")[0]
    assert len(np.load(tmp_path / "a.npz")["actions"]) == 120


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("rate", "FOLDER/nothing.npz"), "nothing.npz"),
        (("rate", "FILE", "--out", "RATINGS"), "--overwrite"),
        (("rate", "FILE", "--out", "FOLDER/new", "--train.seeds", "0"), "seeds"),
        (("rate", "FILE", "--out", "FOLDER/new", "--action", "torque"), "torque"),
        (("curate", "RATINGS", "--out", "FOLDER/b.npz"), "exactly one of"),
        (("report", "FOLDER"), "FOLDER"),
        (("export", "RATINGS/nothing", "--onnx", "FOLDER/a.onnx"), "nothing"),
    ],
)
def test_errors_are_one_line_and_exit_code_1(file, ratings, capsys, tmp_path, words, said):
    places = {"FILE": str(file), "RATINGS": str(ratings), "FOLDER": str(tmp_path)}

    def placed(word):
        for name, place in places.items():
            word = word.replace(name, place)
        return word

    code, out, err = call(capsys, *map(placed, words))
    assert code == 1 and not out
    assert err.startswith("tsallis: ") and err.count("\n") == 1 and placed(said) in err
    assert not (tmp_path / "new").exists()


def test_a_rating_that_agrees_too_little_is_exit_code_2(file, capsys, tmp_path):
    options = ("--train.steps", "20", "--json", "--fail-below", "1.01")
    code, out, _ = call(capsys, "rate", file, "--out", tmp_path / "a", *options)
    assert code == 2 and "usable" in json.loads(out)


def test_ctrl_c_is_exit_code_130(file, capsys, tmp_path, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("torchrl_tsallis.run.rate", interrupted)
    code, _, err = call(capsys, "rate", file, "--out", tmp_path / "a")
    assert code == 130 and err == "tsallis: stopped; nothing was written\n"
