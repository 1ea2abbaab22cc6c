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


@pytest.mark.parametrize("kind", ["tensorboard", "wandb"])
def test_a_rating_is_logged_where_that_is_asked_for(kind, file, capsys, tmp_path, monkeypatch):
    pytest.importorskip(kind)
    for name, value in (("WANDB_MODE", "offline"), ("WANDB_SILENT", "true")):
        monkeypatch.setenv(name, value)
    out = tmp_path / "door"
    code, answer, err = call(capsys, "rate", file, "--out", out, "--train.steps", "20", "--json", "--log", kind)
    assert not code and json.loads(answer)["logs"] == str(tmp_path / "logs"), err
    assert out.is_dir() and not any(path.name == "logs" for path in out.iterdir())
    assert _tables(tmp_path / "logs", kind) == 1
    code, answer, err = call(capsys, "report", out, "--log", kind, "--log-dir", tmp_path / "again")
    assert not code and f"logs: {tmp_path / 'again'}" in answer and _tables(tmp_path / "again", kind) == 1


def _tables(logs, kind):
    """Tables of 12 episodes in a folder of logs."""
    if kind == "wandb":
        return sum(len(json.loads(path.read_text())["data"]) == 12 for path in logs.rglob("*.table.json"))
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(logs / "tensorboard" / "door")).Reload()
    assert events.Tags()["histograms"] == ["ratings/surprise"]
    (tag,) = (tag for tag in events.Tags()["tensors"] if tag.startswith("ratings/episodes"))
    return int(len(events.Tensors(tag)[0].tensor_proto.string_val[0].decode().split("\n")) == 2 + 12)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--log-dir", "logs"), "add --log tensorboard or --log wandb"),
        (("--log", "wandb"), "pip install wandb"),
        (("--log", "mlflow"), ""),
    ],
)
def test_what_cannot_be_logged_is_refused_before_anything_is_done(
    file, ratings, capsys, tmp_path, monkeypatch, words, said
):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    for command in (("rate", file, "--out", tmp_path / "new"), ("report", ratings)):
        page = (ratings / "report.html").stat().st_mtime_ns
        code, out, err = call(capsys, *command, *words)
        assert code == 1 and not out and said in err
        assert not (tmp_path / "new").exists() and (ratings / "report.html").stat().st_mtime_ns == page


def test_a_folder_of_logs_that_cannot_be_is_refused_before_anything_is_done(file, capsys, tmp_path):
    pytest.importorskip("tensorboard")
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file", tmp_path / "file" / "below"):
        words = ("--log", "tensorboard", "--log-dir", place)
        code, out, err = call(capsys, "rate", file, "--out", tmp_path / "new", *words)
        assert code == 1 and not out and "nothing can be written under" in err and err.count("\n") == 1
    assert not (tmp_path / "new").exists()


def test_a_rating_that_cannot_be_logged_is_kept_and_said(file, capsys, tmp_path, monkeypatch):
    pytest.importorskip("tensorboard")

    def full(*args):
        raise OSError("the disk of 'logs' is full")

    monkeypatch.setattr("torchrl_tsallis.report.log_ratings", full)
    words = ("--train.steps", "20", "--json", "--log", "tensorboard")
    code, out, err = call(capsys, "rate", file, "--out", tmp_path / "new", *words)
    assert code == 1 and json.loads(out)["logs"] is None and (tmp_path / "new" / "ratings.csv").exists()
    assert "nothing logged" in err and "disk of 'logs' is full" in err and err.count("\n") == 1


def test_modes_become_a_copy_and_a_policy(file, capsys, tmp_path):
    words = ["--components", "2", "--train.updates", "3", "--train.batch-size", "32", "--json"]
    code, out, err = call(capsys, "modes", file, "--out", tmp_path / "modes", *words)
    answer = json.loads(out)
    assert not code and not err and sum(mode["episodes"] for mode in answer["modes"]) == 12
    best = answer["recommended"]
    code, out, _ = call(capsys, "curate", tmp_path / "modes", "--mode", best, "--out", tmp_path / "copy.npz", "--json")
    assert not code and len(json.loads(out)["kept"]) == answer["modes"][best]["episodes"]
    code, out, _ = call(capsys, "info", tmp_path / "copy.npz")
    assert not code and "NaN" not in out
    for mode, place in ((best, "policy"), ("each", "told")):
        options = ["--mode", mode, "--out", tmp_path / place, "--train.steps", "10", "--json"]
        assert not call(capsys, "train", tmp_path / "modes", *options)[0]
    assert (tmp_path / "modes" / "modes.html").exists()
    code, _, err = call(capsys, "train", tmp_path / "modes", "--mode", "77", "--out", tmp_path / "other")
    assert code == 1 and "mode=77 is none of those" in err and not (tmp_path / "other").exists()
