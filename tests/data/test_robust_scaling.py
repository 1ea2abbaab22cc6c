"""Robust scaling: by hand, in other units, and for dimensions that hardly move."""

from __future__ import annotations

import json
import math

import pytest
import torch
from tensordict import TensorDict

from torchrl_tsallis.data import RobustScaling, Scaling, make_replay_buffer
from torchrl_tsallis.data import robust_scaling as module
from torchrl_tsallis.data.robust_scaling import robust_statistics


def rows(n: int = 2000, seed: int = 0) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)
    observation = torch.randn(n, 3, generator=generator) * torch.tensor([1.0, 10.0, 0.1])
    return TensorDict({"observation": observation, "action": torch.randn(n, 2, generator=generator)}, [n])


def test_quantiles_by_hand():
    centre, scale = robust_statistics(torch.tensor([[0.0], [1.0], [2.0], [3.0]]))
    assert centre.tolist() == [1.5]
    assert scale.item() == pytest.approx((2.25 - 0.75) / 1.34898)


def test_the_scale_of_a_normal_is_its_deviation_and_outliers_do_not_move_it():
    value = torch.randn(100_000, 1, generator=torch.Generator().manual_seed(1)) * 3 + 7
    centre, scale = robust_statistics(value)
    assert centre.item() == pytest.approx(7, abs=0.05) and scale.item() == pytest.approx(3, rel=0.01)
    value[:100] = 1e6
    moved, wider = robust_statistics(value)
    assert moved.item() == pytest.approx(centre.item(), abs=0.01) and wider.item() == pytest.approx(3, rel=0.01)


@pytest.mark.parametrize("factor", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("offset", [0.0, -5.0, 300.0])
def test_data_in_other_units_becomes_the_same(factor, offset):
    data = rows()
    data["action"][:, 1] = (data["action"][:, 1] > 1.5).float()  # a gripper
    other = data.clone()
    other["action"] = factor * (data["action"] + offset)
    other["observation"] = factor * (data["observation"] + offset)
    ours, theirs = RobustScaling.fit(data), RobustScaling.fit(other)
    rounding = 1e-5 * (1 + abs(offset))
    for key in ("action", "observation"):
        torch.testing.assert_close(theirs(other)[key], ours(data)[key], rtol=rounding, atol=10 * rounding)
    torch.testing.assert_close(
        theirs.unscale_action(ours(data)["action"]), other["action"], rtol=rounding, atol=factor * rounding
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_inverse_and_the_dtype(dtype):
    data = rows().apply(lambda x: x.to(dtype))
    scaling = RobustScaling.fit(data)
    scaled = scaling(data)
    assert scaled["action"].dtype == scaled["observation"].dtype == dtype
    tolerance = 1e-6 if dtype == torch.float32 else 1e-14
    torch.testing.assert_close(scaling.unscale_action(scaled["action"]), data["action"], rtol=tolerance, atol=tolerance)
    torch.testing.assert_close(
        scaling.unscale("observation", scaled["observation"][0]), data["observation"][0], rtol=1e-5, atol=tolerance
    )


def almost_still(kind: str) -> torch.Tensor:
    value = torch.full((1000,), 0.3)
    if kind == "one rounding":
        value[::3] = torch.nextafter(value[::3], torch.ones(()))
    if kind == "three roundings":
        value[::2] += 3 * 2**-25
    if kind == "noise of some roundings":
        value += 1e-6 * torch.randn(1000, generator=torch.Generator().manual_seed(0))
    if kind == "one step of some roundings":
        value[7] += 1e-6
    if kind == "numerical noise about zero":
        value = 1e-17 * torch.randn(1000, generator=torch.Generator().manual_seed(0))
    if kind == "rounding of a large number":
        value = 1e6 + value
        value[::7] += 0.0625
    return value


STILL = (
    "constant",
    "one rounding",
    "three roundings",
    "rounding of a large number",
    "noise of some roundings",
    "one step of some roundings",
    "numerical noise about zero",
)


@pytest.mark.parametrize("kind", STILL)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("fit", [RobustScaling.fit, lambda data: Scaling.fit(data, action_unit=1.0)])
def test_a_sensor_that_moves_by_rounding_is_only_centred(kind, dtype, fit):
    value = almost_still(kind)
    observation = torch.stack([torch.randn(1000), value, torch.randn(1000)], 1).to(dtype)
    data = TensorDict({"observation": observation, "action": torch.rand(1000, 1, dtype=dtype)}, [1000])
    scaling = fit(data)
    deployed = TensorDict({"observation": observation[:1] + 0.01, "action": data["action"][:1]}, [1])
    assert scaling(data)["observation"][:, 1].abs().max() < 0.1
    assert scaling(deployed)["observation"][0, 1].abs() < 1


@pytest.mark.parametrize(
    ("share", "noise", "expected"),
    [
        (0.5, 0.0, 1 / 1.34898),  # interquartile range
        (0.2, 0.0, 1 / 3.28971),  # 5 % to 95 %
        (0.03, 0.0, 1 / 4.65270),  # 1 % to 99 %
        (0.004, 0.0, math.sqrt(0.004 * 0.996)),  # deviation
        (0.2, 1e-4, 1 / 3.28971),  # a rest position with noise
        (0.0, 0.0, 1.0),
    ],
)
def test_what_rests_most_of_the_time_falls_back_in_the_documented_order(share, noise, expected):
    value = torch.zeros(1000, 1)
    value[: round(1000 * share)] = 1.0
    value += noise * torch.randn(1000, 1, generator=torch.Generator().manual_seed(0))
    centre, scale = robust_statistics(value)
    assert scale.item() == pytest.approx(expected, rel=1e-3)
    assert ((value - centre) / scale).abs().max() < 17


def test_tiny_units_beside_a_constant_are_units():
    value = torch.stack([1e-12 * torch.randn(1000), torch.full((1000,), 3e-12), torch.full((1000,), 7.0)], 1)
    _, scale = robust_statistics(value)
    assert 0.8e-12 < scale[0] < 1.2e-12 and scale[1:].tolist() == [1.0, 1.0]


def test_long_data_is_taken_in_pieces_with_the_same_result(monkeypatch):
    value = torch.randn(3000, 5, generator=torch.Generator().manual_seed(2))
    value[:, 3], value[:, 4] = 2.0, 0.0
    value[17, 4] = 1.0
    centre, scale = robust_statistics(value)
    monkeypatch.setattr("torchrl_tsallis.data.rows.PIECE", 64)
    again = robust_statistics(value)
    assert torch.equal(again[0], centre) and torch.allclose(again[1], scale, rtol=1e-12)
    monkeypatch.setattr(module, "SAMPLE", 1000)
    centre, scale = robust_statistics(value)
    torch.testing.assert_close(scale[:3], torch.ones(3).double(), rtol=0.1, atol=0)


def test_nested_observations_next_ones_and_what_is_left_alone():
    data = TensorDict(
        {
            "observation": {"state": 5 + 2 * torch.randn(100, 3), "pixels": torch.zeros(100, 2, 2, dtype=torch.uint8)},
            "action": torch.arange(100),
            "next": {"observation": {"state": torch.full((100, 3), 5.0)}},
        },
        [100],
    )
    scaling = RobustScaling.fit(data)
    assert list(scaling.centres) == [("observation", "state")]
    scaled = scaling(data)
    assert torch.equal(scaled["action"], data["action"])
    assert torch.equal(scaled["observation", "pixels"], data["observation", "pixels"])
    assert scaled["next", "observation", "state"].abs().max() < 1
    assert (data["next", "observation", "state"] == 5).all()
    assert torch.equal(scaling.unscale_action(data["action"]), data["action"])


def test_the_state_is_exact_in_tensors_and_in_json():
    data = rows()
    scaling = RobustScaling.fit(data)
    for again in (
        RobustScaling.from_state_dict(scaling.state_dict()),
        RobustScaling.from_json(json.loads(json.dumps(scaling.to_json()))),
    ):
        assert torch.equal(again(data)["observation"], scaling(data)["observation"])
        assert torch.equal(again.unscale_action(data["action"]), scaling.unscale_action(data["action"]))


def test_errors():
    data = rows(10)
    scaling = RobustScaling.fit(data)
    with pytest.raises(ValueError, match=r"'action' has shape \[10, 3\], the scaling was fitted to 2"):
        scaling(data.clone().set("action", torch.zeros(10, 3)))
    with pytest.raises(ValueError, match="'observation' is NaN"):
        RobustScaling.fit(data.clone().set("observation", torch.full((10, 1), torch.nan)))
    with pytest.raises(KeyError, match="no 'action'"):
        RobustScaling.fit(data.exclude("action"))
    with pytest.raises(ValueError, match="no row"):
        RobustScaling.fit(data[:0])
    with pytest.raises(ValueError, match="'mean' is no entry"):
        RobustScaling.from_state_dict({"mean": torch.zeros(1)})
    with pytest.raises(ValueError, match="positive and finite"):
        RobustScaling({"action": torch.zeros(2)}, {"action": torch.tensor([1.0, 0.0])})
    with pytest.raises(ValueError, match="differ in shape"):
        RobustScaling({"action": torch.zeros(2)}, {"action": torch.ones(3)})
    with pytest.raises(ValueError, match="both for each key"):
        RobustScaling({"action": torch.zeros(2)}, {})
    for unit in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="action_unit"):
            Scaling.fit(data, action_unit=unit)
    with pytest.raises(TypeError, match="nested.*RobustScaling"):
        Scaling.fit(data.set("observation", TensorDict({"a": torch.zeros(10, 1)}, [10])), action_unit=1.0)


def test_a_buffer_of_scaled_data_gives_scaled_batches():
    data = rows(64)
    scaling = RobustScaling.fit(data)
    batch = make_replay_buffer(scaling(data), batch_size=64).sample()
    torch.testing.assert_close(
        scaling.unscale_action(batch["action"]).sum(), data["action"].sum(), rtol=1e-4, atol=1e-4
    )
