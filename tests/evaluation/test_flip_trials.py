"""Trials of page flipping, and the recurrent policy in NumPy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.modules import set_recurrent_mode

from torchrl_tsallis.data import Scaling
from torchrl_tsallis.envs import count_flips
from torchrl_tsallis.evaluation import FlipTrial, RecurrentMeanPolicy, longest_single_run, run_flip_trial
from torchrl_tsallis.modules import make_recurrent_policy


@pytest.mark.parametrize(
    ("sizes", "run"), [([], 0), ([2, 3], 0), ([1, 1, 2, 1], 2), ([1, 1, 1], 3), ([2, 1, 1, 1, 1, 2], 4)]
)
def test_a_flip_of_several_pages_breaks_the_succession(sizes, run):
    assert longest_single_run(sizes) == run


def trial_of(turns: list[tuple[int, int]], steps: int = 400) -> FlipTrial:
    angles = np.zeros((steps, 10))
    for page, step in turns:
        angles[step:, page] = 3.0
    return FlipTrial(np.zeros((steps - 1, 3)), np.zeros((steps - 1, 3)), angles, count_flips(angles))


def test_success_is_three_single_flips_in_succession():
    apart = trial_of([(9, 50), (8, 150), (7, 250)]).row
    assert apart == {"flips": 3, "events": 3, "singles": 3, "multiples": 0, "run": 3, "success": 1}
    broken = trial_of([(9, 50), (8, 150), (7, 155), (6, 250), (5, 350)]).row
    assert broken == {"flips": 5, "events": 4, "singles": 3, "multiples": 1, "run": 2, "success": 0}


def test_numpy_policy_equals_the_actor_and_remembers():
    torch.manual_seed(0)
    actor = make_recurrent_policy(4, 2, hidden_size=6).eval()
    data = TensorDict({"observation": 3 * torch.randn(1, 9, 4), "action": torch.zeros(1, 9, 2)}, [1, 9])
    data["is_init"] = torch.zeros(1, 9, 1, dtype=torch.bool)
    scaling = Scaling(torch.randn(4), torch.rand(4) + 0.5, 0.3)
    with torch.no_grad(), set_recurrent_mode(True):
        expected = 0.3 * actor(scaling(data))["loc"][0].numpy()
    policy = RecurrentMeanPolicy.from_state({**actor.state_dict(), **scaling.state_dict()})
    for _ in range(2):
        policy.reset()
        got = np.stack([policy(row) for row in data["observation"][0].numpy()])
        np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-6)
    with pytest.raises(KeyError, match="make_recurrent_policy"):
        RecurrentMeanPolicy.from_state(scaling.state_dict())


class Stub:
    """A policy that counts its steps since ``reset``."""

    def __init__(self, force) -> None:
        self.force, self.count = force, -1

    def reset(self) -> None:
        self.count = 0

    def __call__(self, observation):
        self.count += 1
        return self.force


def test_a_trial_in_the_simulator_is_reproducible_and_limits_the_force():
    for package in ("gymnasium", "pybullet"):
        pytest.importorskip(package)
    policy = Stub(np.array([0.0, 6.0, 0.0]))
    first, second = (run_flip_trial(policy, 5) for _ in range(2))
    assert policy.count == 500 and first.positions.shape == first.forces.shape == (500, 3)
    assert first.angles.shape == (501, 10)
    np.testing.assert_allclose(first.forces, np.tile([0.0, 3.3, 0.0], (500, 1)), rtol=1e-6)
    assert (first.positions == second.positions).all()
    with pytest.raises(ValueError, match="step 0 of seed 5"):
        run_flip_trial(Stub(np.array([np.nan, 0.0, 0.0])), 5)
