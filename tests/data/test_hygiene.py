"""Faults that can be seen without training: each is found where it was made, and clean data has none."""

from __future__ import annotations

import json
import math

import pytest
import torch
from tensordict import TensorDict

from torchrl_tsallis.data import inspect_demonstrations
from torchrl_tsallis.data.hygiene import find_outside, find_saturated
from torchrl_tsallis.data.hygiene_steps import find_copies


def clean(episodes: int = 10, length: int = 60, seed: int = 0) -> TensorDict:
    """Smooth motions from random starts, with noise that is no copy."""
    generator = torch.Generator().manual_seed(seed)
    t = torch.linspace(0, 1, length)
    phase = 6 * torch.rand(episodes, 1, 3, generator=generator)
    observation = (phase + 3 * t[None, :, None] * torch.tensor([1.0, 2.0, -1.0])).sin().flatten(0, 1)
    observation += 0.01 * torch.randn(observation.shape, generator=generator)
    action = torch.randn(episodes * length, 2, generator=generator)
    number = torch.arange(episodes).repeat_interleave(length)
    info = TensorDict({"timestamp": (torch.arange(length) / 50).repeat(episodes).double()}, [episodes * length])
    return TensorDict(
        {"observation": observation, "action": action, "episode": number, "info": info}, [episodes * length]
    )


def found(data: TensorDict, **options) -> dict[str, object]:
    return {finding.kind: finding for finding in inspect_demonstrations(data, **options)}


def test_clean_data_has_no_finding():
    for seed in range(3):
        assert inspect_demonstrations(clean(seed=seed), low=-9.0, high=9.0) == []


def test_nan_rows_are_errors_and_the_rest_is_still_looked_at():
    data = clean()
    data["observation"][[7, 300], 1] = math.nan
    data["action"][:, 1] = 2.0
    findings = inspect_demonstrations(data)
    assert [(f.severity, f.kind, f.key) for f in findings[:2]] == [
        ("error", "non_finite", "observation"),
        ("warning", "constant", "action"),
    ]
    assert findings[0].rows == (7, 300) and findings[0].count == 2 and findings[1].dimensions == (1,)


@pytest.mark.parametrize("value", [0.0, 5.0, "rounding"])
def test_dimensions_that_do_not_move(value):
    data = clean()
    data["observation"][:, 2] = 0.3 if value == "rounding" else value
    if value == "rounding":
        data["observation"][::2, 2] += 2**-25
    finding = found(data)["constant"]
    assert finding.dimensions == (2,) and finding.key == "observation"
    assert finding.where == "'observation'; dimensions 2"


def test_saturated_dimensions_but_no_gripper():
    data = clean()
    data["action"] = data["action"].clamp(-1.0, 1.5)
    data["action"] = torch.cat([data["action"], (data["action"][:, :1] > 0).float()], 1)
    finding = found(data)["saturated"]
    share = (data["action"][:, :2] == -1.0).float().mean(0).max().item()
    assert finding.dimensions == (0, 1) and f"most in {100 * share:.0f} % of the rows" in finding.what
    assert find_saturated(data, share=0.5) == []


def test_actions_outside_of_their_space():
    data = clean()
    data["action"].clamp_(-1, 1)[[3, 99], 1] = torch.tensor([2.0, -7.0])
    finding = found(data, low=-1.0, high=1.0)["outside"]
    assert finding.rows == (3, 99) and finding.dimensions == (1,)
    assert find_outside(data, low=torch.tensor([-1.0, -8.0]), high=torch.tensor([1.0, 2.0])) == []


def test_copied_rows_and_episodes():
    data = clean()
    for key in ("observation", "action"):
        data[key][5] = data[key][400]
        data[key][120:180] = data[key][480:540]  # episode 2 is episode 8
    findings = found(data)
    assert findings["copied_episodes"].episodes == (8,) and "8 of 2" in findings["copied_episodes"].what
    assert findings["copied_episodes"].severity == "error"
    assert findings["copied_rows"].count == 61 and findings["copied_rows"].rows[:2] == (400, 480)
    for key in ("observation", "action"):
        data[key][120:180] = data[key][120:180].flip(0)  # the same rows in another order are another episode
    assert "copied_episodes" not in found(data)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int64, torch.float32, torch.bool])
def test_copies_are_found_in_every_dtype(dtype):
    value = torch.arange(12).reshape(6, 2).to(dtype)
    value[4] = value[1]
    rows = find_copies(TensorDict({"x": value}, [6]), ["x"])[0].rows
    assert 4 in rows and (dtype == torch.bool or rows == (4,))


def test_lengths():
    data = clean()
    data["episode"][300:] += 1
    data["episode"][301:] += 1
    data["episode"][304:] += 1
    findings = found(data)
    assert findings["length_one"].episodes == (5,) and findings["short"].episodes == (6,)


def test_still_stretches():
    data = clean()
    data["observation"][70:95] = data["observation"][70]
    data["observation"][200:206] = data["observation"][200]  # too short to be one
    finding = found(data)["still"]
    assert finding.rows == (70,) and finding.count == 24 and finding.episodes == (1,)
    assert "in 1 stretches, 24 of 600 steps" in finding.what


def test_wrong_boundaries():
    joined = clean()
    joined["episode"] = joined["episode"] // 2 * 2
    assert set(found(joined)["jump"].rows) <= {59, 179, 299, 419, 539}
    data = clean()
    data["observation"][200:240] += 40.0
    finding = found(data)["jump"]
    assert finding.rows == (199,) and finding.episodes == (3,)  # row 239 is the last of its episode
    pieces = clean(episodes=2, length=600)
    pieces["episode"] = torch.arange(1200) // 50
    assert 15 <= found(pieces)["continued"].count <= 22  # of 23; one step in ten is larger than the quantile


def test_times():
    data = clean()
    data["info", "timestamp"][130:180] += 1.0
    data["info", "timestamp"][50] = data["info", "timestamp"][49]
    finding = found(data)["time"]
    assert finding.episodes == (0, 2) and 129 in finding.rows and 49 in finding.rows and "0.02 s" in finding.what
    with pytest.raises(ValueError, match="5 timestamps for 600 rows"):
        inspect_demonstrations(data, timestamps=torch.zeros(5))


def test_contradicting_ends_are_a_finding():
    data = clean().set("is_init", torch.zeros(600, dtype=torch.bool))
    finding = found(data)["episodes"]
    assert finding.severity == "error" and "contradict" in finding.what


def test_pairs_images_and_choices():
    data = TensorDict({"observation": torch.zeros(9, 3, 4, 4, dtype=torch.uint8), "action": torch.arange(9)}, [9])
    assert inspect_demonstrations(data) == []
    with pytest.raises(ValueError, match="no row"):
        inspect_demonstrations(data[:0])
    with pytest.raises(KeyError, match="no 'action'"):
        inspect_demonstrations(data.exclude("action"))


def test_findings_are_json():
    data = clean()
    data["observation"][:, 0] = 1.0
    (finding,) = inspect_demonstrations(data)
    assert json.loads(json.dumps(finding.to_json()))["where"] == "'observation'; dimensions 0"


def test_pieces_change_nothing(monkeypatch):
    data = clean()
    data["observation"][70:95] = data["observation"][70]
    data["action"][:, 1] = data["action"][:, 1].clamp(-1, 1)
    whole = inspect_demonstrations(data, low=-1.0, high=1.0)
    assert len(whole) >= 3
    monkeypatch.setattr("torchrl_tsallis.data.rows.PIECE", 100)
    assert inspect_demonstrations(data, low=-1.0, high=1.0) == whole
