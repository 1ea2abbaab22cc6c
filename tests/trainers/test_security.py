"""A crafted checkpoint runs no code and writes nowhere, whatever component it is in; names stay in their folder."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import zipfile
from pathlib import Path

import pytest
import torch
from tensordict import NonTensorData, NonTensorStack, TensorDict

from torchrl_tsallis.trainers import EvaluationHook, UnsafeCheckpointError, check_checkpoint, make_logger, resume

COMPONENTS = ["collector", "logger", "loss_module", "optimizer", "policy", "target_updater", "trainer_state"]
MODULES = ["optimization_stepper", "sampler", "q_tuner", "rng", "evaluation", "extra"]
COMPONENTS += [f"trainer_module.{name}" for name in MODULES]


class Payload:
    """Its unpickling leaves a mark, as any code could be run instead."""

    mark = ""

    def __init__(self, mark: str | Path) -> None:
        self.mark = str(mark)

    def __reduce__(self):
        return os.mkdir, (self.mark,)


class Extra:
    """A component by dump and load, which loads a tensordict as TorchRL's own do."""

    def dump(self, path):
        TensorDict({"x": torch.zeros(2)}).memmap(path / "state")

    def load(self, path):
        TensorDict.load_memmap(path / "state")


def other_pickle(state: Path, mark: Path) -> None:
    """A folder of NonTensorData beside the tensors, as tensordict writes one of an object that is no JSON."""
    NonTensorData(data=object).memmap(state / "extra")
    (state / "extra" / "other.pickle").write_bytes(pickle.dumps({"data": Payload(mark)}))
    refer(state, "NonTensorData")


def stack_pickle(state: Path, mark: Path) -> None:
    """A stack of objects, which tensordict keeps in another file."""
    NonTensorStack(NonTensorData(data=object), NonTensorData(data=int)).memmap(state / "extra")
    (state / "extra" / "pickle.pkl").write_bytes(pickle.dumps([Payload(mark), 1]))
    refer(state, "NonTensorStack")


def hidden_pickle(state: Path, mark: Path) -> None:
    """The folder of the state itself becomes one of NonTensorData."""
    meta = json.loads((state / "meta.json").read_text())
    meta["_type"] = "<class 'tensordict.tensorclass.NonTensorData'>"
    (state / "meta.json").write_text(json.dumps(meta))
    (state / "other.pickle").write_bytes(pickle.dumps({"data": Payload(mark)}))


def torch_file(state: Path, mark: Path) -> None:
    """A file of torch.save, which TorchRL prefers to the folder."""
    torch.save(Payload(mark), state.parent / "state.pt")


def archive(state: Path, mark: Path) -> None:
    """An archive of tensordict's in the place of the folder."""
    other_pickle(state, mark)
    shutil.make_archive(str(state.parent / "state"), "zip", state)
    (state.parent / "state.zip").rename(state.parent / "state.tdz")
    shutil.rmtree(state)


def class_without_a_file(state: Path, mark: Path) -> None:
    """An object of another class than tensors, without any pickle."""
    NonTensorData(data="text").memmap(state / "extra")
    refer(state, "NonTensorData")
    mark.with_name("no_code").touch()


def refer(state: Path, kind: str) -> None:
    meta = json.loads((state / "meta.json").read_text())
    (state / "meta.json").write_text(json.dumps(meta | {"extra": {"type": kind}}))


CRAFTS = [other_pickle, stack_pickle, hidden_pickle, torch_file, archive, class_without_a_file]


@pytest.fixture
def make(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    from train_small import make_trainer

    def make():
        trainer, _ = make_trainer(tmp_path / "run", steps=8, logger=make_logger("csv", tmp_path, "log"))
        EvaluationHook(lambda: {"return": 0.0}, every=4).register(trainer)
        trainer.register_module("extra", Extra())
        return trainer

    return make


def newest(folder: Path) -> Path:
    return max((path for path in folder.iterdir() if not path.name.startswith(".")), key=lambda path: path.name)


def publish(folder: Path, target: Path, form: str) -> None:
    """Lists all files in the manifest, and writes the folder as a checkpoint of either form."""
    manifest = json.loads((folder / "manifest.json").read_text())
    for record in manifest["components"].values():
        root = folder / record["path"]
        record["files"] = sorted(path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file())
    (folder / "manifest.json").write_text(json.dumps(manifest))
    if form == "folder":
        shutil.move(folder, target.with_suffix(""))
        target.unlink()
        return
    with zipfile.ZipFile(target, "w") as file:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                file.write(path, path.relative_to(folder).as_posix())


def unpacked(checkpoint: Path, folder: Path) -> dict[str, Path]:
    """The components' folders."""
    with zipfile.ZipFile(checkpoint) as file:
        file.extractall(folder)
    manifest = json.loads((folder / "manifest.json").read_text())
    return {name: folder / record["path"] for name, record in manifest["components"].items()}


@pytest.fixture
def checkpoint(make, tmp_path):
    make().train()
    return newest(tmp_path / "run")


@pytest.mark.parametrize("form", ["archive", "folder"])
@pytest.mark.parametrize("component", COMPONENTS)
def test_no_component_is_unpickled(make, checkpoint, tmp_path, component, form):
    mark = tmp_path / "code_was_run"
    for number, craft in enumerate(CRAFTS):
        folder = tmp_path / f"crafted{number}"
        whole = checkpoint.read_bytes()
        components = unpacked(checkpoint, folder)
        assert set(components) == set(COMPONENTS)  # a new component needs a test here
        craft(components[component] / "state", mark)
        publish(folder, checkpoint, form)
        with pytest.raises(UnsafeCheckpointError, match="could run code.*do not load checkpoints of others"):
            resume(make())
        assert not mark.exists(), craft.__name__
        shutil.rmtree(checkpoint.with_suffix(""), ignore_errors=True)
        checkpoint.write_bytes(whole)
    assert resume(make()) == 8


def test_the_crafted_files_would_run_code_without_the_check(make, checkpoint, tmp_path, monkeypatch):
    mark = tmp_path / "code_was_run"
    other_pickle(unpacked(checkpoint, tmp_path / "crafted")["collector"] / "state", mark)
    publish(tmp_path / "crafted", checkpoint, "archive")
    monkeypatch.setattr("torchrl_tsallis.trainers.checkpoints.check_checkpoint", lambda path: None)
    with pytest.warns(FutureWarning, match="only safe for trusted data"):
        resume(make())
    assert mark.exists()


@pytest.mark.parametrize(
    "name",
    ["../evil.json", "/tmp/evil.json", "state/../../evil.json", "..\\evil.json", "C:/evil.json", "a/..\\..\\b.json"],
)
def test_a_member_that_leads_out_of_the_archive_is_refused(make, checkpoint, name):
    with zipfile.ZipFile(checkpoint, "a") as file:
        file.writestr(zipfile.ZipInfo(name), "{}")
    with pytest.raises(UnsafeCheckpointError, match="leads out of it"):
        resume(make())


@pytest.mark.parametrize("path", ["../elsewhere", "/tmp", "components/../.."])
@pytest.mark.parametrize("form", ["archive", "folder"])
def test_a_component_elsewhere_is_refused(make, checkpoint, tmp_path, path, form):
    folder = tmp_path / "crafted"
    unpacked(checkpoint, folder)
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["components"]["collector"]["path"] = path
    if form == "folder":
        (folder / "manifest.json").write_text(json.dumps(manifest))
        shutil.move(folder, checkpoint.with_suffix(""))
        checkpoint.unlink()
    else:
        with zipfile.ZipFile(checkpoint, "w") as file:
            file.writestr("manifest.json", json.dumps(manifest))
    with pytest.raises(UnsafeCheckpointError, match="lists .* which leads out of it"):
        resume(make())


def test_a_member_that_is_there_twice_is_refused(make, checkpoint):
    with zipfile.ZipFile(checkpoint, "a") as file, pytest.warns(UserWarning, match="Duplicate name"):
        file.writestr("manifest.json", "{}")
    with pytest.raises(UnsafeCheckpointError, match="'manifest.json' twice"):
        check_checkpoint(checkpoint)


def test_a_link_in_a_folder_is_refused(make, checkpoint, tmp_path):
    components = unpacked(checkpoint, tmp_path / "crafted")
    shutil.move(components["policy"] / "state", tmp_path / "elsewhere")
    (components["policy"] / "state").symlink_to(tmp_path / "elsewhere")
    publish(tmp_path / "crafted", checkpoint, "folder")
    with pytest.raises(UnsafeCheckpointError, match="holds the link"):
        resume(make())


@pytest.mark.parametrize("name", ["..", "../run", "/tmp/run", "a/b", "", ".", "a\\b", "C:run", "a\0b"])
def test_a_run_s_name_stays_in_its_folder(tmp_path, name):
    with pytest.raises(ValueError, match="the run's name"):
        make_logger("csv", tmp_path / "logs", name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["../../loss", "/tmp/loss", "a/../../b", "", "a//b", "..\\loss", "a/.", "C:\\loss"])
@pytest.mark.parametrize("kind", ["csv", "tensorboard"])
def test_a_quantity_s_name_stays_in_the_run_s_folder(tmp_path, name, kind):
    logger = make_logger(kind, tmp_path / "logs", "run")
    before = sorted(tmp_path.rglob("*"))
    for log in (
        lambda: logger.log_scalar(name, 1.0, step=1),
        lambda: logger.log_histogram(name, [1.0], step=1),
        lambda: logger.log_picture(name, "picture.png", step=1),
        lambda: logger.log_video(name, "video.gif", step=1),
        lambda: logger.log_table(name, [{"a": 1}]),
    ):
        with pytest.raises(ValueError, match="leads out of its folder"):
            log()
    assert sorted(tmp_path.rglob("*")) == before
    logger.shutdown()
