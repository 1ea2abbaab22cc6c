"""Units, split by trajectory, and the buffer of slices."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from torchrl_tsallis import AdaTerm, CATSoftUpdate, PredictiveBCLoss, QTuner
from torchrl_tsallis.data import Scaling, make_sequence_buffer, split_trajectories
from torchrl_tsallis.modules import make_recurrent_policy
from torchrl_tsallis.trainers import make_offline_trainer, resume


def trajectories(count: int = 6, steps: int = 10) -> TensorDict:
    """Observation: trajectory and step."""
    number = torch.arange(count).repeat_interleave(steps)
    time = torch.arange(steps).repeat(count)
    observation = torch.stack([number, time], 1).float()
    ends = (time == steps - 1)[:, None]
    following = {"observation": observation + torch.tensor([0.0, 1.0]), "done": ends, "truncated": ends.clone()}
    data = {"observation": observation, "action": observation / 10, "is_init": (time == 0)[:, None]}
    info = TensorDict({"is_noise": time > 5}, [count * steps])
    return TensorDict({**data, "next": TensorDict(following, [count * steps]), "info": info}, [count * steps])


def test_slices_are_runs_of_one_trajectory_and_begin_anew():
    buffer = make_sequence_buffer(trajectories(), slice_len=4, num_slices=3)
    starts = set()
    for _ in range(20):
        sample = buffer.sample()
        assert sample.shape == (3, 4) and "info" not in sample.keys()  # noqa: SIM118
        number, time = sample["observation"].unbind(-1)
        assert (number == number[:, :1]).all() and (time.diff(dim=1) == 1).all()
        assert sample["is_init"][:, 0].all() and not sample["is_init"][:, 1:].any()
        starts |= set(time[:, 0].tolist())
    assert starts == set(range(7))


def test_an_epoch_sees_every_trajectory_once():
    buffer = make_sequence_buffer(trajectories(), slice_len=10, num_slices=2)
    for _ in range(2):
        seen = torch.cat([buffer.sample()["observation"] for _ in range(3)])
        assert sorted(seen[:, 0, 0].tolist()) == list(range(6))
        assert (seen[..., 1] == torch.arange(10)).all()


def test_the_seed_alone_decides_the_order():
    def order(seed: int, other: int) -> torch.Tensor:
        torch.manual_seed(other)
        buffer = make_sequence_buffer(trajectories(), slice_len=3, num_slices=2, seed=seed)
        return torch.cat([buffer.sample()["observation"] for _ in range(5)])

    assert torch.equal(order(1, 0), order(1, 5)) and not torch.equal(order(1, 0), order(2, 0))


@pytest.mark.parametrize(
    ("change", "settings", "message"),
    [
        ({}, {"slice_len": 11}, "6 trajectories of at least 10 steps do not give 2 slices of 11"),
        ({}, {"num_slices": 7}, "do not give 7 slices"),
        ({"action": math.nan}, {}, "'action' is NaN or infinite in 1 rows, first .3."),
        ({("next", "observation"): math.inf}, {}, "next.*observation.*first .3."),
    ],
)
def test_data_that_does_not_fit(change, settings, message):
    data = trajectories()
    for key, value in change.items():
        data[key][3, 0] = value
    with pytest.raises(ValueError, match=message):
        make_sequence_buffer(data, **({"slice_len": 4, "num_slices": 2} | settings))


def test_missing_entries_and_open_ends():
    with pytest.raises(KeyError, match="is_init"):
        make_sequence_buffer(trajectories().exclude("is_init"), slice_len=4, num_slices=2)
    with pytest.raises(ValueError, match="no end"):
        make_sequence_buffer(trajectories()[:-1], slice_len=4, num_slices=2)
    with pytest.raises(ValueError, match="no end"):
        split_trajectories(trajectories()[:-1], 0.5)


def test_the_split_is_by_trajectory():
    data = trajectories()
    training, validation = split_trajectories(data, 0.34, seed=3)
    numbers = [set(part["observation"][:, 0].tolist()) for part in (training, validation)]
    assert (len(training), len(validation)) == (40, 20)
    assert not numbers[0] & numbers[1] and numbers[0] | numbers[1] == set(range(6))
    assert torch.equal(split_trajectories(data, 0.34, seed=3)[1]["observation"], validation["observation"])
    for share in (0.0, 1.0, 0.99):
        with pytest.raises(ValueError, match="nothing on one side"):
            split_trajectories(data, share)


def test_scaling_and_its_state():
    data = trajectories()
    data["observation"][:, 0] = 7.0  # constant
    scaling = Scaling.fit(data, action_unit=0.5)
    scaled = scaling(data)
    assert (scaled["observation"][:, 0] == 0).all()
    assert scaled["observation"][:, 1].std(correction=0) == pytest.approx(1.0)
    torch.testing.assert_close(scaled["next", "observation"][0, 1], scaled["observation"][1, 1])
    torch.testing.assert_close(scaled["action"], data["action"] / 0.5)
    assert torch.equal(data["action"], trajectories()["action"])
    again = Scaling.from_state_dict(scaling.state_dict())
    assert (again(data) == scaled).all()
    with pytest.raises(ValueError, match="action_unit"):
        Scaling.fit(data, action_unit=0.0)


def trained(folder: Path | None, steps: int) -> tuple[dict, list[int]]:
    torch.manual_seed(1)
    loss = PredictiveBCLoss(make_recurrent_policy(2, 2, hidden_size=4))
    trainer = make_offline_trainer(
        loss,
        make_sequence_buffer(trajectories(), slice_len=4, num_slices=2, seed=2),
        AdaTerm(loss.parameters()),
        updater=CATSoftUpdate(loss),
        tuner=QTuner(loss),
        steps=steps,
        log_every=2,
        checkpoint_dir=folder,
        checkpoint_every=2,
        progress=False,
    )
    done = 0 if folder is None else resume(trainer)
    trainer.train()
    return loss.state_dict(), [done]


def test_a_resumed_training_is_the_unbroken_one(tmp_path):
    whole, _ = trained(None, 10)
    trained(tmp_path, 4)  # in the middle of an epoch of three batches
    resumed, (done,) = trained(tmp_path, 10)
    assert done == 4
    assert all(torch.equal(resumed[name], value) for name, value in whole.items())
