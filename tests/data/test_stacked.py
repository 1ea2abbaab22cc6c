"""Stacked members get the batches that they would get alone."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_tsallis.data import MemberSampler, make_replay_buffer, make_stacked_replay_buffer


def data_of(rows: int, start: float = 0.0) -> TensorDict:
    value = start + torch.arange(float(rows)).unsqueeze(-1)
    return TensorDict({"observation": value, "action": -value}, [rows])


@pytest.mark.parametrize("shared", [True, False])
def test_order_is_that_of_the_single_buffers(shared):
    sizes = [23, 23, 23] if shared else [23, 40, 16]
    data = [data_of(23)] * 3 if shared else [data_of(n, 100.0 * k) for k, n in enumerate(sizes)]
    seeds = [5, 0, 7]
    stacked = make_stacked_replay_buffer(data[0] if shared else data, seeds=seeds, batch_size=8)
    single = [make_replay_buffer(d, batch_size=8, seed=s) for d, s in zip(data, seeds, strict=True)]
    assert len(stacked) == (23 if shared else sum(sizes))
    for _ in range(12):  # several epochs of every member
        batch = stacked.sample()
        assert batch.shape == (3, 8)
        for k, buffer in enumerate(single):
            expected = buffer.sample()
            assert torch.equal(batch[k]["observation"], expected["observation"])
            assert torch.equal(batch[k]["action"], expected["action"])


def test_data_that_is_given_twice_is_stored_once():
    first, second = data_of(8), data_of(8, 100.0)
    buffer = make_stacked_replay_buffer([first, second, first], seeds=[0, 1, 2], batch_size=4)
    assert len(buffer) == 16
    assert (buffer.sample()[2]["observation"] < 100).all()


@pytest.mark.parametrize("before", [0, 1, 5, 6])
def test_state_dict_continues_exactly(before):
    rows = [range(0, 20), range(20, 37)]
    sampler = MemberSampler([3, 4], rows)
    for _ in range(before):
        sampler.sample(None, 6)
    other = MemberSampler([8, 9], rows)
    other.load_state_dict(sampler.state_dict())
    for _ in range(9):
        assert torch.equal(sampler.sample(None, 6)[0], other.sample(None, 6)[0])
    again = MemberSampler([0, 0], rows)
    again.load_state_dict(other.state_dict())
    assert torch.equal(again.sample(None, 6)[0], sampler.sample(None, 6)[0])


def test_batches_of_changing_size_and_a_late_state_are_those_of_the_single_samplers():
    together, alone = MemberSampler([3, 4], [range(20), range(20)]), [MemberSampler([s], [range(20)]) for s in (3, 4)]
    for size in (6, 6, 4, 7, 20, 3, 17, 1, 6):
        index, _ = together.sample(None, size)
        assert torch.equal(index, torch.cat([sampler.sample(None, size)[0] for sampler in alone]))
        index.zero_()  # nothing that is given away is the sampler's own
    resumed = MemberSampler([0, 0], [range(20), range(20)])
    resumed.load_state_dict(together.state_dict())
    for size in (6, 9, 6):
        assert torch.equal(resumed.sample(None, size)[0], together.sample(None, size)[0])


def test_dumps_and_loads(tmp_path):
    sampler = MemberSampler([3, 4], [range(20), range(20)])
    sampler.sample(None, 6)
    sampler.dumps(tmp_path / "sampler")
    other = MemberSampler([0, 0], [range(20), range(20)])
    other.loads(tmp_path / "sampler")
    assert torch.equal(sampler.sample(None, 6)[0], other.sample(None, 6)[0])


def test_errors():
    with pytest.raises(ValueError, match="1 seeds and 2 ranges"):
        MemberSampler([0], [range(4), range(4)])
    with pytest.raises(ValueError, match="member 1 has 3 samples"):
        MemberSampler([0, 1], [range(8), range(8, 11)]).sample(None, 4)
    with pytest.raises(ValueError, match="3 members, there are 2"):
        three = MemberSampler([0, 1, 2], [range(8)] * 3)
        MemberSampler([0, 1], [range(8)] * 2).load_state_dict(three.state_dict())
    bad = data_of(8)
    bad["action"][3] = torch.nan
    with pytest.raises(ValueError, match="'action' is NaN or infinite in 1 of 16 rows"):
        make_stacked_replay_buffer([data_of(8), bad], seeds=[0, 1], batch_size=4)
    with pytest.raises(KeyError, match="no 'action'"):
        make_stacked_replay_buffer(data_of(8).exclude("action"), seeds=[0, 1], batch_size=4)
