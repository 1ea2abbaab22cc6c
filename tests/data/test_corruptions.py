"""Corruptions: right share, right labels, nothing else touched."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_tsallis.data import TASKS, add_action_noise, make_task, replace_with_amateur


def demonstrations(trajectories: int, length: int, experts: int = 1, value: float = 0.0) -> TensorDict:
    n = trajectories * length
    episode = torch.arange(trajectories).repeat_interleave(length)
    info = {"episode": episode, "expert": episode * experts // trajectories}
    info |= {"is_noise": torch.zeros(n, dtype=torch.bool), "is_amateur": torch.zeros(n, dtype=torch.bool)}
    return TensorDict(
        {"observation": torch.randn(n, 3), "action": torch.full((n, 2), value), "info": TensorDict(info, [n])}, [n]
    )


def test_noise_has_the_asked_share_and_moments():
    data = demonstrations(10, 2000)
    before = data.clone()
    noisy = add_action_noise(data, seed=3)
    hit = noisy["info", "is_noise"]
    assert 0.09 < hit.float().mean() < 0.11
    assert 4.9 < noisy["action"][hit].mean() < 5.1
    assert 0.9 < noisy["action"][hit].std() < 1.1
    assert (noisy["action"][~hit] == 0).all()
    assert torch.equal(noisy["observation"], data["observation"])
    assert (data == before).all()
    assert torch.equal(add_action_noise(data, seed=3)["action"], noisy["action"])
    assert not torch.equal(add_action_noise(data, seed=4)["action"], noisy["action"])


def test_one_trajectory_of_each_expert_is_replaced():
    experts, amateur = demonstrations(30, 5, experts=3), demonstrations(3, 5, value=9.0)
    out = replace_with_amateur(experts, amateur, seed=1)
    by_amateur = out["info", "is_amateur"]
    assert len(out) == 150
    assert by_amateur.sum() == 15
    assert (out["action"][by_amateur] == 9).all()
    assert (out["action"][~by_amateur] == 0).all()
    assert out["info", "expert"][by_amateur].unique().tolist() == [0, 1, 2]
    assert torch.equal(out["info", "episode"], experts["info", "episode"])
    assert not experts["info", "is_amateur"].any()


@pytest.mark.parametrize("task", TASKS)
def test_tasks(task):
    out = make_task(task, demonstrations(10, 50), demonstrations(1, 50, value=9.0))
    artificial, with_amateur = TASKS[task]
    assert out["info", "is_noise"].any() == artificial
    assert out["info", "is_amateur"].sum() == (50 if with_amateur else 0)


def test_errors():
    data = demonstrations(2, 4)
    with pytest.raises(ValueError, match="clean, artificial, amateur, both"):
        make_task("all", data, data)
    with pytest.raises(ValueError, match="probability"):
        add_action_noise(data, probability=1.5)
    with pytest.raises(ValueError, match="per_expert=3"):
        replace_with_amateur(data, data, per_expert=3)


@pytest.mark.parametrize("side", ["experts", "amateur"])
@pytest.mark.parametrize("order", [[0, 1, 0], [1, 1, 0, 1], [2, 0, 2, 0]])
def test_a_number_in_two_runs_of_rows_is_refused(side, order):
    data = {"experts": demonstrations(4, 5), "amateur": demonstrations(1, 5, value=9.0)}
    whole = demonstrations(len(order), 5)
    whole["info", "episode"] = torch.tensor(order).repeat_interleave(5)
    data[side] = whole
    with pytest.raises(ValueError, match=f"trajectory {1 if 1 in order[3:] else 0} of the {side} stands in two runs"):
        replace_with_amateur(data["experts"], data["amateur"])
