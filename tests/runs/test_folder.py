"""The folder of a run appears whole or not at all, and says what is wrong with it."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal

import pytest

from torchrl_tsallis.run import Run, rate, train
from torchrl_tsallis.runs import folder as folders
from torchrl_tsallis.runs.folder import check_free, new_folder
from torchrl_tsallis.trainers.stepper import GuardedStepper

QUICK = {"steps": 5, "progress": False}


@pytest.fixture(scope="module")
def original(file, tmp_path_factory):
    return rate(file, tmp_path_factory.mktemp("runs") / "run", seeds=2, **QUICK).folder


@pytest.fixture
def broken(original, tmp_path):
    return shutil.copytree(original, tmp_path / "run")


def use_all(run, file):
    """Reads every file of the folder."""
    run.network()
    run.numpy_policy()
    run.rate(file)
    return run.summary, run.episodes, run.ratings


FILES = ["run.json", "policy.safetensors", "rating.safetensors", "scaling.json", *folders.TABLES]


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_is_missing_is_named(broken, file, name):
    (broken / name).unlink()
    with pytest.raises(FileNotFoundError, match=rf"{name}' is not there: .*(make|give)"):
        use_all(Run.open(broken), file)


@pytest.mark.parametrize("share", [0.0, 0.5, 0.999])
@pytest.mark.parametrize("name", FILES)
def test_a_file_that_is_cut_is_named(broken, file, name, share):
    content = (broken / name).read_bytes()
    (broken / name).write_bytes(content[: min(int(share * len(content)), len(content) - 2)])
    with pytest.raises(ValueError, match=rf"{name}' .*: make the run again"):
        use_all(Run.open(broken), file)


@pytest.mark.parametrize("name", FILES)
def test_a_file_of_other_bytes_is_named(broken, file, name):
    (broken / name).write_bytes(bytes(range(128, 256)))
    with pytest.raises(ValueError, match=rf"{name}' .*: make the run again"):
        use_all(Run.open(broken), file)


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_cannot_be_read_is_named(broken, file, name):
    (broken / name).unlink()
    (broken / name).mkdir()  # no permission would not keep the superuser from reading
    with pytest.raises(OSError, match=rf"cannot read .*{name}' \(.*\): check"):
        use_all(Run.open(broken), file)


def change(place, name, edit):
    settings = json.loads((place / name).read_text())
    edit(settings)
    (place / name).write_text(json.dumps(settings))


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (
            lambda s: s.update(format=2, versions={"torchrl_tsallis": "0.9"}),
            "format 2, written by .* 0.9; .*pip install",
        ),
        (lambda s: s.update(format=2, versions=None), "written by torchrl_tsallis a later version"),
        (lambda s: s.update(format="1"), "has the format '1', this version reads 1"),
        (lambda s: s.pop("policy"), "does not say 'policy.factory'"),
        (lambda s: s["policy"].update(arguments=[3]), "does not say 'policy.arguments.obs_dim'"),
        (lambda s: s["policy"].update(factory="os.system"), "policy of 'os.system', which is not known"),
        (lambda s: s["policy"]["arguments"].update(obs_dim=4), "policy.safetensors' is no state of the policy"),
        (lambda s: s["policy"]["arguments"].update(depth=4), "policy.safetensors' is no state of the policy"),
        (lambda s: s["data"].update(keys=None), "does not say 'data.keys.observation'"),
        (lambda s: s["method"].update(rating="oracle"), "rating 'oracle' of run.json is not known"),
        (lambda s: s["method"].update(u="much"), "describes no rating"),
        (lambda s: s["method"].update(rating="tsallis", q=0.5, gamma=[0, 0]), "rating.safetensors' is no state"),
        (lambda s: s["data"].update(steps=7), "ratings.csv' ends after 720 rows, run.json says 7"),
    ],
)
def test_settings_that_do_not_fit_are_said(broken, file, edit, message):
    change(broken, "run.json", edit)
    with pytest.raises(ValueError, match=message):
        use_all(Run.open(broken), file)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda s: s.pop("action.scale"), "is no scaling"),
        (lambda s: s.update({"action.scale": [1.0, 0.0]}), "is no scaling"),
        (lambda s: s.update({"action.scale": [1.0], "action.centre": [0.0]}), "does not scale the policy's"),
        (lambda s: s.update({"action.scale": "wide"}), "is no scaling"),
        (lambda s: (s.pop("action.scale"), s.pop("action.centre")), "does not scale the policy's"),
    ],
)
def test_a_scaling_that_does_not_fit_is_said(broken, file, edit, message):
    change(broken, "scaling.json", edit)
    with pytest.raises(ValueError, match=f"scaling.json' {message}.*make the run again"):
        use_all(Run.open(broken), file)


def test_a_folder_that_is_no_run_is_said(tmp_path):
    for place in (tmp_path, tmp_path / "nothing"):
        with pytest.raises(FileNotFoundError, match=r"run.json' is not there: give the folder of a run"):
            Run.open(place)


def test_nothing_is_replaced_without_being_told(file, broken):
    before = {path.name: path.read_bytes() for path in broken.iterdir()}
    with pytest.raises(FileExistsError, match="overwrite=True"):
        train(file, broken, **QUICK)
    (broken / "notes.txt").write_text("mine")
    with pytest.raises(FileExistsError, match=r"holds more than a run \(notes.txt\)"):
        train(file, broken, overwrite=True, **QUICK)
    (broken / "notes.txt").unlink()
    assert {path.name: path.read_bytes() for path in broken.iterdir()} == before
    train(file, broken, overwrite=True, **QUICK)
    assert not (broken / "episodes.csv").exists()
    assert [path.name for path in broken.parent.iterdir()] == ["run"]


def test_what_is_no_run_is_never_replaced(file, tmp_path):
    (tmp_path / "thesis.txt").write_text("x")
    for place in (tmp_path, tmp_path / "thesis.txt"):
        with pytest.raises(FileExistsError, match="is no run"):
            train(file, place, overwrite=True, **QUICK)


def test_data_and_output_do_not_lie_in_one_another(tmp_path, broken, file):
    copy = shutil.copy(file, broken / "own.npz")
    with pytest.raises(ValueError, match="lie in one another"):
        rate(copy, broken, overwrite=True, **QUICK)
    with pytest.raises(ValueError, match="lie in one another"):
        check_free(tmp_path / "data" / "ratings", False, tmp_path / "data")


def test_an_earlier_run_is_back_if_it_cannot_be_replaced(broken, monkeypatch):
    before = {path.name: path.read_bytes() for path in broken.iterdir()}
    place, replace = broken, os.replace

    def fails(source, target):
        if target == place and "old" not in str(source):
            raise KeyboardInterrupt
        replace(source, target)

    monkeypatch.setattr(folders.os, "replace", fails)
    with pytest.raises(KeyboardInterrupt), new_folder(place, overwrite=True) as working:
        (working / "run.json").write_text("{}")
    assert {path.name: path.read_bytes() for path in broken.iterdir()} == before
    assert [path.name for path in broken.parent.iterdir()] == ["run"]


@pytest.mark.parametrize("function", [rate, train])
def test_ctrl_c_while_it_trains_leaves_nothing(file, tmp_path, monkeypatch, function):
    step = GuardedStepper.step

    def stopped(self, *args, **options):
        os.kill(os.getpid(), signal.SIGINT)
        return step(self, *args, **options)

    monkeypatch.setattr(GuardedStepper, "step", stopped)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # it is ignored where tests run in the background
    try:
        with pytest.raises(KeyboardInterrupt):
            function(file, tmp_path / "deep" / "run", **QUICK)
    finally:
        signal.signal(signal.SIGINT, before)
    assert list((tmp_path / "deep").iterdir()) == []


@pytest.mark.parametrize("limit", [10, 2000, 20_000])
@pytest.mark.parametrize("function", [rate, train])
def test_a_full_disk_leaves_nothing(file, tmp_path, function, limit):
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))  # every file, at so many bytes
    try:
        with pytest.raises(OSError, match="cannot write .*: check the folder's permissions and the free space"):
            function(file, tmp_path / "run", **QUICK)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
    assert list(tmp_path.iterdir()) == []
