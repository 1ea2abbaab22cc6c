"""Groups that lie apart: silhouettes by hand, and how many groups there are."""

from __future__ import annotations

import pytest
import torch

from torchrl_tsallis.modes import separated, silhouettes
from torchrl_tsallis.modes.separation import best_split, cut


def apart(*places):
    place = torch.tensor(places).double()
    return (place[:, None] - place).abs()


def test_silhouettes_by_hand():
    # of 0: own group 1 away, the next one (5 + 7) / 2 = 6 away; of 1: 1 and 5; of 5 and 7: 2 and 4.5, 2 and 6.5
    found = silhouettes(apart(0, 1, 5, 7), [[0, 1], [2, 3]])
    torch.testing.assert_close(found, torch.tensor([5 / 6, 4 / 5, 2.5 / 4.5, 4.5 / 6.5]).double())


def test_an_episode_in_the_wrong_group_is_below_zero_and_one_alone_is_zero():
    found = silhouettes(apart(0, 1, 10, 11, 50), [[0, 1, 2], [3], [4]])
    assert found[2] < -0.8 and found[3] == found[4] == 0


def test_episodes_that_are_all_equal_are_one_group_without_a_division_by_zero():
    assert silhouettes(torch.zeros(4, 4), [[0, 1], [2, 3]]).tolist() == [0] * 4
    assert separated(torch.zeros(4, 4)) == [[0, 1, 2, 3]]


@pytest.mark.parametrize("count", [2, 3, 5, 10])
def test_any_number_of_groups_is_found(count):
    distances = torch.full((4 * count, 4 * count), 1.0).double()
    for k in range(count):
        own = slice(4 * k, 4 * k + 4)
        distances[own, own] = 0.3
    assert separated(distances.fill_diagonal_(0)) == [list(range(4 * k, 4 * k + 4)) for k in range(count)]


def test_one_episode_far_away_does_not_hide_how_the_others_differ():
    assert separated(apart(0, 1, 2, 20, 21, 22, 5000)) == [[0, 1, 2], [3, 4, 5], [6]]


def test_places_along_a_line_are_one_group():
    # a split in halves has silhouettes of about 0.5 at the ends, and of 0 in the middle
    assert separated(apart(*range(12)), least=0.7) == [list(range(12))]
    value, groups = best_split(apart(*range(12)))
    assert value < 0.7 and len(groups) > 1


def test_the_least_silhouette_decides():
    distances = apart(0, 1, 5, 7)
    value, _ = best_split(distances)
    assert value == pytest.approx((5 / 6 + 4 / 5 + 2.5 / 4.5 + 4.5 / 6.5) / 4)
    assert separated(distances, value) == [[0, 1], [2, 3]] and separated(distances, value + 0.01) == [[0, 1, 2, 3]]


def test_a_number_of_groups_can_be_asked_for():
    assert [len(group) for group in cut(apart(0, 1, 10, 11, 50), 3)] == [2, 2, 1]
    assert cut(apart(0, 1), 1) == [[0, 1]] and cut(apart(0, 1), 2) == [[0], [1]]
    with pytest.raises(ValueError, match="count"):
        cut(apart(0, 1), 3)


def test_two_episodes_have_no_split():
    assert best_split(apart(0, 9)) == (0.0, [[0, 1]])
