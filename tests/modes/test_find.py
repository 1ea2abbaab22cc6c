"""From demonstrations to modes: by hand where numbers matter, and on demonstrators who act by opposite signs."""

from __future__ import annotations

import pytest
import torch

from tests.modes.test_mixture import demonstrations
from torchrl_tsallis.modes import Modes, adjusted_rand_index, find_modes, find_modes_of_each


def modes_of(groups, pairs, starts=((0, 0, 1, 1), (1, 1, 0, 0))):
    return Modes(groups, torch.tensor(pairs, dtype=torch.float64), torch.tensor(starts))


PAIRS = [[1.0, 0.8, 0.6, 0.0], [0.8, 1.0, 0.4, 0.0], [0.6, 0.4, 1.0, 0.2], [0.0, 0.0, 0.2, 1.0]]


def test_membership_leaves_the_episode_itself_out():
    found = modes_of(((0, 1, 2), (3,)), PAIRS)
    # (0.8 + 0.6) / 2, (0.8 + 0.4) / 2, (0.6 + 0.4) / 2; the others' mean for the last one: (0 + 0 + 0.2) / 3
    assert found.membership[0].tolist() == pytest.approx([0.7, 0.6, 0.5, 0.2 / 3])
    assert found.membership[1].tolist() == pytest.approx([0.0, 0.0, 0.2, 0.0])
    assert found.certainty.tolist() == pytest.approx([0.6, 0.0])
    assert found.share.tolist() == [0.75, 0.25]
    assert found.of_episodes.tolist() == [0, 0, 0, 1]


def test_a_smaller_mode_that_starts_agree_on_is_recommended_over_a_larger_one_that_they_do_not():
    pairs = torch.eye(5).double()
    pairs[:3, :3] = 0.5
    pairs[3:, 3:] = 1.0
    starts = torch.zeros(2, 5, dtype=torch.int64)
    found = Modes(((0, 1, 2), (3, 4)), pairs.fill_diagonal_(1.0), starts)
    assert found.recommended == 1  # 0.6 * 0.5 < 0.4 * 1


def test_agreement_is_the_mean_over_pairs_of_starts():
    starts = ((0, 0, 1, 1), (1, 1, 0, 0), (0, 1, 0, 1))
    assert modes_of(((0, 1), (2, 3)), PAIRS, starts).agreement == pytest.approx((1.0 - 0.5 - 0.5) / 3)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_demonstrators_are_told_apart_in_any_unit(unit):
    data, true = demonstrations((6, 6))
    data["action"] *= unit
    found = find_modes(data, components=3, starts=3, updates=30, batch_size=32)
    assert found.agreement > 0.2
    large = [group for group in found.groups if len(group) > 1]
    assert all(len({int(true[episode]) for episode in group}) == 1 for group in large)
    assert adjusted_rand_index(found.of_episodes, true) > 0.5


def test_demonstrations_of_one_kind_are_not_split():
    data, _ = demonstrations((6, 6), sign=(1.0, 1.0))
    found = find_modes(data, components=3, starts=4, updates=30, batch_size=32)
    assert found.groups == (tuple(range(12)),) and found.recommended == 0
    assert found.agreement < 0.2 and found.membership.tolist() == [[1.0] * 12]


def test_the_same_seed_gives_the_same_modes_and_leaves_random_numbers_alone():
    data, _ = demonstrations((6, 6))
    options = {"components": 2, "starts": 2, "updates": 4, "batch_size": 16, "always": True}
    state = torch.get_rng_state()
    first, again = find_modes(data, **options), find_modes(data, **options)
    assert torch.get_rng_state().equal(state)
    assert first.groups == again.groups and first.pairs.equal(again.pairs)


def test_sets_beside_one_another_are_found_as_each_alone():
    sets = [demonstrations((6, 6), seed=seed)[0] for seed in (0, 1)]
    options = {"components": 2, "starts": 2, "updates": 4, "batch_size": 16, "always": True}
    both = find_modes_of_each(sets, seeds=[5, 7], **options)
    assert not both[0].pairs.allclose(both[1].pairs, atol=1e-2)
    for data, seed, found in zip(sets, (5, 7), both, strict=True):
        alone = find_modes(data, seed=seed, **options)
        assert found.pairs.allclose(alone.pairs, atol=1e-4) and found.groups == alone.groups


def test_a_seed_a_set_is_asked_for():
    data, _ = demonstrations()
    with pytest.raises(ValueError, match="1 sets and 2 seeds: give one seed a set"):
        find_modes_of_each([data], seeds=[0, 1])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("components", 1),
        ("starts", 1),
        ("updates", 0),
        ("threshold", 0.0),
        ("seed", -1),
        ("batch_size", 0),
    ],
)
def test_numbers_that_cannot_be_are_refused_by_name(name, value):
    data, _ = demonstrations()
    with pytest.raises(ValueError, match=name):
        find_modes(data, **{name: value})


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("action", torch.zeros(256, dtype=torch.long), "'action' is no vector of floating-point numbers"),
        ("observation", torch.zeros(256, 3, 4, 4), "'observation' is no vector of floating-point numbers"),
        ("action", torch.full((256, 1), float("nan")), "'action' is NaN or infinite in 256 of 256 rows"),
    ],
)
def test_what_a_mixture_cannot_take_is_named(key, value, said):
    data, _ = demonstrations()
    with pytest.raises(ValueError, match=said):
        find_modes(data.set(key, value))


def test_a_missing_key_is_named():
    data, _ = demonstrations()
    with pytest.raises(KeyError, match="action"):
        find_modes(data.exclude("action"))


def test_too_few_episodes_and_pairs_are_refused_with_the_reason():
    data, _ = demonstrations((2, 2))
    with pytest.raises(ValueError, match="4 episodes are too few to find modes among them: record at least 6"):
        find_modes(data)
    with pytest.raises(ValueError, match="pairs without episodes, which a search for modes needs"):
        find_modes(data.exclude("episode"))
