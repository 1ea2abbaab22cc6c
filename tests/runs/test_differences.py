"""How modes differ, by hand."""

from __future__ import annotations

import pytest
import torch

from torchrl_tsallis.data.episodes import Episodes
from torchrl_tsallis.runs.differences import differences, parts_of_episodes
from torchrl_tsallis.runs.labels import compare_labels


def test_parts_are_tenths_of_each_episode_whatever_its_length():
    part = parts_of_episodes(Episodes(torch.tensor([0, 20]), torch.tensor([20, 5])))
    assert part[:20].tolist() == [k // 2 for k in range(20)] and part[20:].tolist() == [0, 2, 4, 6, 8]


def test_only_rows_of_the_two_modes_count_and_each_pair_is_symmetric():
    means = torch.tensor([[[0.0], [0.0], [0.0]], [[1.0], [3.0], [9.0]], [[2.0], [2.0], [2.0]]])
    found = differences(means, torch.tensor([0, 1, 2]), torch.tensor([0, 0, 0]), torch.tensor([2.0]), parts=1)
    assert found[0, 1].item() == pytest.approx((1 + 3) / 2 / 2)  # row 2 is of neither
    assert found[0, 2].item() == pytest.approx((2 + 2) / 2 / 2)
    assert found[1, 2].item() == pytest.approx((1 + 7) / 2 / 2)  # rows 1 and 2
    assert found.transpose(0, 1).equal(found) and not found.diagonal().any()


def test_labels_that_cut_across_modes_agree_by_chance():
    found = compare_labels(["a", "b", "a", "b"], [0, 0, 1, 1])
    assert found["rand_index"] == pytest.approx(-0.5) and found["episodes"] == {
        "a": {"0": 1, "1": 1},
        "b": {"0": 1, "1": 1},
    }
