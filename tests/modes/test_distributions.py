"""Distances between the distributions of episodes: by hand, at their limits, and in any unit."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_tsallis.modes import areas_between, behaviour, distribution_functions


def test_changes_do_not_reach_over_the_start_of_an_episode():
    data = TensorDict({"observation": torch.tensor([[1.0], [3.0], [9.0], [8.0]]), "action": torch.zeros(4, 1)}, [4])
    seen = behaviour(data, torch.tensor([0, 0, 1, 1]))
    assert seen.tolist() == [[1, 0, 0, 0], [3, 0, 2, 0], [9, 0, 0, 0], [8, 0, -1, 0]]
    assert behaviour(data[:1], torch.tensor([0])).tolist() == [[1, 0, 0, 0]]


def test_functions_at_quantiles_of_all_rows_by_hand():
    values = torch.tensor([[0.0], [1.0], [2.0], [3.0]])  # the levels are 0, 1 and 2
    found = distribution_functions(values, torch.tensor([0, 0, 0, 1]), 2, levels=3)
    torch.testing.assert_close(found[:, 0], torch.tensor([[1 / 3, 2 / 3, 1], [0, 0, 0]]).double())


def test_rows_that_are_equal_stay_together():
    same = distribution_functions(torch.ones(6, 2), torch.tensor([0, 0, 0, 1, 1, 1]), 2, levels=4)
    assert (same == 1).all()


def test_an_area_by_hand():
    one, two = [[0.5, 1.0], [0.5, 0.5]], [[0.0, 0.75], [0.5, 0.5]]
    wanted = (0.5 + 0.25 + 0 + 0) / 4
    found = areas_between(torch.tensor([one, two]).double())
    torch.testing.assert_close(found, torch.tensor([[0.0, wanted], [wanted, 0.0]]).double())


def test_an_area_is_the_distance_of_ranks_where_levels_are_many():
    # Episodes at ranks of the lower, the middle and the upper third: means of 1/6, 1/2 and 5/6.
    values = torch.arange(3000.0)[:, None]
    found = areas_between(distribution_functions(values, torch.arange(3000) // 1000, 3, levels=2999))
    wanted = torch.tensor([[0, 1, 2], [1, 0, 1], [2, 1, 0]]).double() / 3
    torch.testing.assert_close(found, wanted, atol=1e-3, rtol=0)


@pytest.mark.parametrize("change", [lambda x: 1e-3 * x, lambda x: 1e3 * x + 7, lambda x: x.exp(), lambda x: x**3])
def test_nothing_depends_on_units_or_on_any_increasing_function(change):
    values, episode = torch.randn(400, 3, generator=torch.Generator().manual_seed(0)).double(), torch.arange(400) // 40
    assert distribution_functions(values, episode, 10).equal(distribution_functions(change(values), episode, 10))


def test_distances_are_symmetric_and_between_0_and_1():
    values = torch.randn(300, 2, generator=torch.Generator().manual_seed(1))
    values[:30] += 100
    found = areas_between(distribution_functions(values, torch.arange(300) // 30, 10))
    assert found.equal(found.T) and found.diagonal().abs().max() == 0 and found.min() >= 0 and found.max() <= 1
    assert found[0, 1:].min() > 0.4 > 0.2 > found[1:, 1:].max()


def test_a_dimension_that_never_changes_and_wild_values_do_no_harm():
    values = torch.randn(200, 1, generator=torch.Generator().manual_seed(2))
    episode = torch.arange(200) // 20
    still = torch.cat([values, torch.full_like(values, 3.0)], 1)
    torch.testing.assert_close(
        areas_between(distribution_functions(still, episode, 10)),
        areas_between(distribution_functions(values, episode, 10)) / 2,
    )
    wild = values.clone()
    wild[3] = 1e30
    found = areas_between(distribution_functions(wild, episode, 10))
    usual = areas_between(distribution_functions(values, episode, 10))
    assert (found - usual).abs().max() <= 1 / 20  # one row of 20


def test_no_level_is_refused():
    with pytest.raises(ValueError, match="levels"):
        distribution_functions(torch.zeros(4, 1), torch.zeros(4, dtype=torch.long), 1, levels=0)
