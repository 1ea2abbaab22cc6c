"""From demonstrations to modes: by hand where numbers matter, and on demonstrators who act by opposite signs."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from tests.modes.test_mixture import demonstrations
from torchrl_tsallis.modes import Modes, adjusted_rand_index, find_modes, find_modes_of_each
from torchrl_tsallis.modes.separation import SURE


def modes_of(pairs, starts=((0, 0, 1, 1), (1, 1, 0, 0)), **options):
    return Modes.of_starts(torch.tensor(pairs, dtype=torch.float64), torch.tensor(starts), **options)


PAIRS = [[1.0, 0.8, 0.6, 0.0], [0.8, 1.0, 0.4, 0.0], [0.6, 0.4, 1.0, 0.2], [0.0, 0.0, 0.2, 1.0]]


def test_membership_leaves_the_episode_itself_out():
    found = modes_of(PAIRS)
    assert found.groups == ((0, 1, 2), (3,)) and found.by == "policies"
    # (0.8 + 0.6) / 2, (0.8 + 0.4) / 2, (0.6 + 0.4) / 2
    assert found.membership.tolist() == pytest.approx([0.7, 0.6, 0.5, 0.0])
    assert found.certainty.tolist() == pytest.approx([0.6, 0.0])
    assert found.share.tolist() == [0.75, 0.25]
    assert found.of_episodes.tolist() == [0, 0, 0, 1]


def test_a_smaller_mode_that_starts_agree_on_is_recommended_over_a_larger_one_that_they_do_not():
    pairs = torch.eye(5).double()
    pairs[:3, :3] = 0.5
    pairs[3:, 3:] = 1.0
    found = Modes.of_starts(pairs.fill_diagonal_(1.0), torch.tensor([[0, 0, 0, 1, 1]] * 2))
    assert found.groups == ((0, 1, 2), (3, 4)) and found.recommended == 1  # 0.6 * 0.5 < 0.4 * 1


def test_evidence_is_the_mean_agreement_over_pairs_of_starts():
    starts = ((0, 0, 1, 1), (1, 1, 0, 0), (0, 1, 0, 1))
    assert modes_of(PAIRS, starts).evidence == pytest.approx((1.0 - 0.5 - 0.5) / 3)
    assert modes_of(PAIRS, starts).groups == ((0, 1, 2, 3),) and len(modes_of(PAIRS, starts, always=True).groups) == 2


def places(*where, rows=40, seed=0, noise=0.1):
    """An episode a place, about which observations and actions are."""
    draw = torch.Generator().manual_seed(seed)
    place = torch.tensor(where).double().repeat_interleave(rows)[:, None]
    observation = place + noise * torch.randn(len(place), 3, generator=draw)
    action = -place + noise * torch.randn(len(place), 2, generator=draw)
    return TensorDict({"observation": observation, "action": action,
                       "episode": torch.arange(len(place)) // rows}, [len(place)])  # fmt: skip


def test_operators_who_are_elsewhere_lie_apart_and_one_mode_is_one():
    found = find_modes(places(0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 7.0))
    assert found.groups == ((0, 2, 4), (1, 3, 5), (6,)) and found.by == "distributions" and found.evidence > 0.6
    assert found.membership[:6].min() > 0.5 and found.membership[6] == 0 and found.recommended in (0, 1)
    one = find_modes(places(*[0.0] * 12))
    assert one.groups == (tuple(range(12)),) and one.evidence < 0.5 and one.membership.tolist() == [1.0] * 12


def test_habits_that_vary_without_a_gap_are_one_mode():
    draw = torch.Generator().manual_seed(3)
    data = places(*[0.0] * 30)
    for key in ("observation", "action"):
        habits = torch.rand(30, data[key].shape[1], generator=draw).double()  # each dimension has one of its own
        data[key] += habits.repeat_interleave(40, 0)
    found = find_modes(data)
    assert len(found.groups) == 1 and found.evidence < 0.5


@pytest.mark.parametrize("noise", [0.01, 0.1, 1.0])
def test_one_habit_that_decides_everything_is_never_sure(noise):
    for seed in range(4):
        place = torch.rand(30, generator=torch.Generator().manual_seed(seed)).tolist()
        assert find_modes(places(*place, noise=noise)).evidence < SURE


def test_distributions_do_not_see_opposite_signs_that_policies_do():
    data, true = demonstrations((6, 6))
    assert len(find_modes(data).groups) == 1
    options = {"components": 3, "starts": 3, "updates": 30, "batch_size": 32}
    assert adjusted_rand_index(find_modes(data, by="policies", **options).of_episodes, true) > 0.5


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_modes_that_lie_apart_are_the_same_in_any_unit(unit):
    data = places(0.0, 1.0, 0.0, 1.0, 0.0, 1.0)
    scaled = data.clone().set("action", data["action"] * unit)
    assert find_modes(scaled).pairs.allclose(find_modes(data).pairs)


def test_a_number_of_modes_can_be_asked_for():
    found = find_modes(places(*[0.0] * 8), components=3)
    assert len(found.groups) == 3 and found.evidence < 0.5
    with pytest.raises(ValueError, match="components"):
        find_modes(places(*[0.0] * 8), components=9)
    with pytest.raises(ValueError, match="always=True without components"):
        find_modes(places(*[0.0] * 8), always=True)


def test_what_is_not_known_or_too_many_episodes_are_refused(monkeypatch):
    with pytest.raises(ValueError, match="by='labels': choose of distributions, policies"):
        find_modes(places(*[0.0] * 8), by="labels")
    monkeypatch.setattr("torchrl_tsallis.modes.find.MOST_EPISODES", 7)
    with pytest.raises(ValueError, match="8 episodes are too many to compare each with each, the limit is 7"):
        find_modes(places(*[0.0] * 8))


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_demonstrators_are_told_apart_in_any_unit(unit):
    data, true = demonstrations((6, 6))
    data["action"] *= unit
    found = find_modes(data, by="policies", components=3, starts=3, updates=30, batch_size=32)
    assert found.evidence > 0.2
    large = [group for group in found.groups if len(group) > 1]
    assert all(len({int(true[episode]) for episode in group}) == 1 for group in large)
    assert adjusted_rand_index(found.of_episodes, true) > 0.5


def test_demonstrations_of_one_kind_are_not_split():
    data, _ = demonstrations((6, 6), sign=(1.0, 1.0))
    found = find_modes(data, by="policies", components=3, starts=4, updates=30, batch_size=32)
    assert found.groups == (tuple(range(12)),) and found.recommended == 0
    assert found.evidence < 0.2 and found.membership.tolist() == [1.0] * 12


def test_the_same_seed_gives_the_same_modes_and_leaves_random_numbers_alone():
    data, _ = demonstrations((6, 6))
    options = {"components": 2, "starts": 2, "updates": 4, "batch_size": 16, "always": True}
    state = torch.get_rng_state()
    first, again = find_modes(data, by="policies", **options), find_modes(data, by="policies", **options)
    assert torch.get_rng_state().equal(state)
    assert first.groups == again.groups and first.pairs.equal(again.pairs)


def test_sets_beside_one_another_are_found_as_each_alone():
    sets = [demonstrations((6, 6), seed=seed)[0] for seed in (0, 1)]
    options = {"components": 2, "starts": 2, "updates": 4, "batch_size": 16, "always": True}
    both = find_modes_of_each(sets, seeds=[5, 7], **options)
    assert not both[0].pairs.allclose(both[1].pairs, atol=1e-2)
    for data, seed, found in zip(sets, (5, 7), both, strict=True):
        alone = find_modes(data, by="policies", seed=seed, **options)
        assert found.pairs.allclose(alone.pairs, atol=1e-4) and found.groups == alone.groups


def test_a_seed_a_set_is_asked_for():
    data, _ = demonstrations()
    with pytest.raises(ValueError, match="1 sets and 2 seeds: give one seed a set"):
        find_modes_of_each([data], seeds=[0, 1])


@pytest.mark.parametrize("by", ["distributions", "policies"])
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
def test_numbers_that_cannot_be_are_refused_by_name(name, value, by):
    data, _ = demonstrations()
    with pytest.raises(ValueError, match=name):
        find_modes(data, by=by, **{name: value})


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
