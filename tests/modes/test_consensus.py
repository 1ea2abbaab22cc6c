"""What several starts agree on."""

from __future__ import annotations

import pytest
import torch

from torchrl_tsallis.modes import adjusted_rand_index, consensus, together


def hard(*names):
    """Responsibilities of a start by the component of each episode."""
    return torch.nn.functional.one_hot(torch.tensor(names)).T.double()


def test_starts_with_other_names_and_numbers_of_components_are_counted_alike():
    pairs = together([hard(0, 0, 1, 1), hard(1, 1, 0, 2)])
    assert pairs.tolist() == [[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 1, 0.5], [0, 0, 0.5, 1]]


def test_what_is_together_in_most_starts_is_a_mode():
    # the third episode changes hands once in three starts, the last is with another one each time
    starts = [hard(0, 0, 0, 1, 1, 2), hard(0, 0, 0, 1, 1, 0), hard(2, 2, 1, 1, 1, 1)]
    assert consensus(together(starts)) == [[0, 1, 2], [3, 4], [5]]


def test_average_linkage_by_hand():
    # 0 and 1 merge at 0.9; to 2 their mean is (0.8 + 0.1) / 2 = 0.45, less than a half
    pairs = torch.tensor([[1.0, 0.9, 0.8], [0.9, 1.0, 0.1], [0.8, 0.1, 1.0]])
    assert consensus(pairs) == [[0, 1], [2]]
    assert consensus(pairs, threshold=0.45) == [[0, 1, 2]]


def test_no_agreement_leaves_every_episode_alone_and_full_agreement_one_mode():
    assert consensus(torch.eye(3)) == [[0], [1], [2]]
    assert consensus(torch.ones(3, 3)) == [[0, 1, 2]]
    assert consensus(torch.ones(1, 1)) == [[0]]


def test_a_mode_does_not_depend_on_the_order_of_the_episodes():
    generator = torch.Generator().manual_seed(0)
    pairs = torch.rand(15, 15, generator=generator)
    pairs = (pairs + pairs.T) / 2
    groups = {frozenset(group) for group in consensus(pairs)}
    order = torch.randperm(15, generator=generator)
    other = consensus(pairs[order][:, order])
    assert 1 < len(groups) < 15 and {frozenset(order[group].tolist()) for group in other} == groups


@pytest.mark.parametrize("starts", [[], [torch.ones(1, 3), torch.ones(1, 4)]])
def test_starts_of_other_episodes_are_refused(starts):
    with pytest.raises(ValueError, match="starts were given"):
        together(starts)


def test_rand_index_by_hand():
    # Table [[2, 1], [0, 3]]: pairs together in both 1 + 3 = 4; in rows 3 + 3 = 6, in columns 1 + 6 = 7, of 15;
    # chance 6 * 7 / 15 = 2.8; (4 - 2.8) / (6.5 - 2.8)
    found = adjusted_rand_index(torch.tensor([0, 0, 0, 1, 1, 1]), torch.tensor([0, 0, 1, 1, 1, 1]))
    assert found == pytest.approx(1.2 / 3.7)


def test_rand_index_where_there_is_one_group_or_one_episode():
    one = torch.zeros(4, dtype=torch.int64)
    assert adjusted_rand_index(one, one) == adjusted_rand_index(torch.arange(4), torch.arange(4)) == 1.0
    assert adjusted_rand_index(one, torch.arange(4)) == 0.0
    assert adjusted_rand_index(one[:1], one[:1]) == 1.0
