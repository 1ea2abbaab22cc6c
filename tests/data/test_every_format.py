"""Every format goes through every command: info, rate, report, curate, train and export."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("tyro")

from torchrl_tsallis.cli import main
from torchrl_tsallis.data.readers import read_demonstrations

EPISODES, STEPS = 12, 8


def arrays() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(EPISODES * STEPS, 3)).astype(np.float32)
    a = (np.tanh(x[:, :2]) + 0.1 * rng.normal(size=(len(x), 2))).astype(np.float32)
    return {"observations": x, "actions": a, "terminals": np.arange(len(x)) % STEPS == STEPS - 1}


def npz(folder: Path, **_) -> tuple[Path, str]:
    np.savez(folder / "data.npz", **arrays())
    return folder / "data.npz", "copy.npz"


def table(folder: Path, **_) -> tuple[Path, str]:
    data = arrays()
    rows = np.column_stack([np.arange(len(data["actions"])) // STEPS, data["observations"], data["actions"]])
    names = "episode,observation.0,observation.1,observation.2,action.0,action.1"
    np.savetxt(folder / "data.csv", rows, delimiter=",", header=names, comments="", fmt="%.6g")
    return folder / "data.csv", "copy.csv"


def ted(folder: Path, **_) -> tuple[Path, str]:
    data = {name: torch.from_numpy(value) for name, value in arrays().items()}
    done = data["terminals"][:, None]
    rows = {
        "observation": data["observations"],
        "action": data["actions"],
        "next": TensorDict({"done": done}, len(done)),
    }
    TensorDict(rows, [len(done)]).memmap(folder / "ted")
    return folder / "ted", "copy"


def robomimic(folder: Path, write_robomimic, **_) -> tuple[Path, str]:
    names = {f"demo_{3 * k}": STEPS for k in range(EPISODES)}
    path = write_robomimic(folder / "data.hdf5", names)
    with h5py.File(path, "r+") as file:
        for k, name in enumerate(names):
            part = slice(k * STEPS, (k + 1) * STEPS)
            file[f"data/{name}/obs/eef_pos"][...] = arrays()["observations"][part]
            file[f"data/{name}/actions"][...] = arrays()["actions"][part]
    return path, "copy.hdf5"


def minari(folder: Path, write_minari, **_) -> tuple[Path, str]:
    return write_minari("box"), "toy/copy-v0"


def lerobot(folder: Path, fixtures, **_) -> tuple[Path, str]:
    return fixtures / "lerobot_v3", "copy"


FORMATS = {"npz": npz, "csv": table, "ted": ted, "robomimic": robomimic, "minari": minari, "lerobot": lerobot}


def call(capsys, *words) -> dict:
    """The answer of a command that must not fail."""
    with pytest.raises(SystemExit) as stop:
        main([*map(str, words), "--json"])
    out, err = capsys.readouterr()
    assert not stop.value.code, err
    return json.loads(out)


@pytest.mark.parametrize("name", FORMATS)
def test_a_file_becomes_a_rating_a_copy_and_a_policy(name, tmp_path, capsys, fixtures, write_robomimic, write_minari):
    source, copy = FORMATS[name](
        tmp_path, fixtures=fixtures, write_robomimic=write_robomimic, write_minari=write_minari
    )
    said = call(capsys, "info", source)
    assert said["format"] == name
    quick = ("--train.steps", 5, "--train.batch-size", 8)
    rated = call(capsys, "rate", source, "--out", tmp_path / "ratings", "--train.seeds", 2, *quick)
    assert Path(rated["report"]).stat().st_size > 10_000
    assert call(capsys, "report", tmp_path / "ratings")["report"] == rated["report"]
    names = [row["source"] for row in _episodes(tmp_path / "ratings")]
    (tmp_path / "keep.json").write_text(json.dumps(names[1:]))
    done = call(
        capsys, "curate", tmp_path / "ratings", "--out", tmp_path / "out" / copy, "--list", tmp_path / "keep.json"
    )
    assert list(done["dropped"]) == names[:1]
    options = {"filter_key": "curated"} if name == "robomimic" else {}
    whole, rest = read_demonstrations(source).data, read_demonstrations(tmp_path / "out" / copy, **options).data
    torch.testing.assert_close(rest["action"], whole["action"][-len(rest) :])
    assert len(rest) == done["steps_kept"] < len(whole)
    filtered = ("--filter-key", "curated") if name == "robomimic" else ()
    call(capsys, "train", tmp_path / "out" / copy, "--out", tmp_path / "policy", *quick, *filtered)
    if name in ("npz", "robomimic"):  # it is the same for all, and slow
        pytest.importorskip("onnxscript")
        call(capsys, "export", tmp_path / "policy", "--onnx", tmp_path / "policy.onnx")


def _episodes(folder: Path) -> list[dict[str, str]]:
    from torchrl_tsallis.runs import Run

    return Run.open(folder).episodes
