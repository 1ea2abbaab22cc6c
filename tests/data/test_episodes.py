"""Where episodes end: by flags, by number, by first steps, and never by two that disagree."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_tsallis.data import episodes as module
from torchrl_tsallis.data import find_episodes, fold_episodes, make_sequence_buffer, split_episodes
from torchrl_tsallis.data.demonstrations import validate_demonstrations

T, F = True, False
#: Three episodes of 2, 3 and 1 rows, told in every way.
NUMBER = torch.tensor([5, 5, 2, 2, 2, 9])
DONE = torch.tensor([F, T, F, F, T, T])
INIT = torch.tensor([T, F, T, F, F, T])


def data(**entries) -> TensorDict:
    following = {key: entries.pop(key) for key in ("done", "terminated", "truncated") if key in entries}
    rows = {"observation": torch.arange(6.0)[:, None], "action": torch.rand(6, 1), **entries}
    return TensorDict({**rows, **({"next": TensorDict(following, [6])} if following else {})}, [6])


@pytest.mark.parametrize(
    "entries",
    [
        {"done": DONE},
        {"done": DONE[:, None]},
        {"done": DONE.to(torch.uint8)},
        {"done": DONE.float()[:, None]},
        {"terminated": torch.tensor([F, T, F, F, F, F]), "truncated": torch.tensor([F, F, F, F, T, T])},
        {"done": torch.tensor([F, T, F, F, F, F]), "truncated": torch.tensor([F, F, F, F, T, T])},
        {"episode": NUMBER},
        {"episode": NUMBER[:, None].float()},
        {"is_init": INIT},
        {"is_init": INIT[:, None]},
        {"info": TensorDict({"episode": NUMBER}, [6])},
        {"done": DONE, "is_init": INIT, "episode": NUMBER},
        {"done": torch.tensor([F, T, F, F, F, T]), "is_init": INIT},  # the second ends with neither flag
        {"terminated": torch.tensor([F, T, F, F, F, F]), "episode": NUMBER},  # none but the first has a flag
        {"done": DONE, "info": TensorDict({"episode": torch.zeros(6)}, [6])},  # a label contradicts nothing
    ],
)
@pytest.mark.parametrize("step", [1, 2, 4, 2**20])
def test_every_way_of_telling_gives_the_same(entries, step, monkeypatch):
    monkeypatch.setattr(module, "_STEP", step)
    found = find_episodes(data(**entries))
    assert found.starts.tolist() == [0, 2, 5] and found.lengths.tolist() == [2, 3, 1]
    assert found.ends.tolist() == [1, 4, 5]
    assert found.of_rows().tolist() == [0, 0, 1, 1, 1, 2]


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"done": DONE, "is_init": torch.tensor([T, F, F, F, F, T])}, r"done.* first \[1\], but 'is_init' does not"),
        ({"done": DONE, "is_init": torch.zeros(6, dtype=torch.bool)}, r"after 2 rows, first \[1, 4\]"),
        (
            {"truncated": DONE, "episode": torch.tensor([5, 5, 2, 2, 2, 2])},
            r"truncated.* first \[4\], but 'episode' go",
        ),
        ({"is_init": INIT, "episode": torch.tensor([5, 5, 5, 5, 5, 9])}, r"'is_init' begins.* first \[1\], but 'epis"),
        (
            {"is_init": torch.tensor([T, F, F, F, F, T]), "episode": NUMBER},
            r"'episode' changes.* first \[1\], but 'is_",
        ),
        ({"done": torch.tensor([F, T, F, F, T, F])}, "the last trajectory has no end"),
        ({"episode": torch.tensor([5, 5, 2, 2, 5, 5])}, "episode 5 of 'episode' stands in two runs.* row 0.* row 4"),
        ({"episode": torch.tensor([5.0, 5, 2, 2, torch.nan, 7])}, "'episode' is NaN or infinite at row 4"),
        ({"done": DONE[:, None].expand(6, 2)}, r"'done'.* has shape \[6, 2\], needed is \[6\] or \[6, 1\]"),
        ({"is_init": torch.tensor([1, 0, 3, 0, 0, 1])}, "'is_init' is 3 at row 2"),
        ({"done": torch.tensor([0, 1, 0, torch.nan, 1, 1])}, "'done'.* is nan at row 3"),
        ({}, "pairs without episodes, which a test needs"),
    ],
)
@pytest.mark.parametrize("step", [1, 2, 2**20])
def test_contradictions_name_rows(entries, message, step, monkeypatch):
    monkeypatch.setattr(module, "_STEP", step if "after 2" not in message else 2**20)
    with pytest.raises(ValueError, match=message):
        find_episodes(data(**entries), purpose="a test")


def test_pairs_are_refused_only_where_episodes_are_needed():
    pairs = data()
    validate_demonstrations(pairs)
    for call in (lambda: split_episodes(pairs, 0.5), lambda: fold_episodes(pairs, 2)):
        with pytest.raises(ValueError, match="pairs without episodes, which a split .* needs"):
            call()
    with pytest.raises(ValueError, match="pairs without episodes, which a buffer of slices needs"):
        make_sequence_buffer(pairs, slice_len=1, num_slices=1, keys=["observation", "action"])


def test_validation_finds_contradictions_but_takes_a_cut_recording():
    validate_demonstrations(data(done=torch.tensor([F, T, F, F, T, F])))
    with pytest.raises(ValueError, match="contradict"):
        validate_demonstrations(data(done=DONE, is_init=INIT.roll(1)))


def test_the_split_is_the_same_however_ends_are_told():
    parts = [split_episodes(data(**entries), 0.4, seed=1) for entries in ({"done": DONE}, {"episode": NUMBER})]
    for a, b in zip(*parts, strict=True):
        assert torch.equal(a["observation"], b["observation"])


def test_folds_hold_every_episode_out_once():
    whole = data(episode=NUMBER)
    folds = fold_episodes(whole, 2, seed=3)
    assert torch.stack(folds).sum(0).tolist() == [1] * 6
    numbers = [set(NUMBER[mask].tolist()) for mask in folds]
    assert not numbers[0] & numbers[1] and sorted(map(len, numbers)) == [1, 2]
    assert all(torch.equal(a, b) for a, b in zip(folds, fold_episodes(whole, 2, seed=3), strict=True))
    assert len({str(fold_episodes(whole, 3, seed=seed)) for seed in range(9)}) > 1
    for count in (0, 1, 4, 2.0, True):
        with pytest.raises(ValueError, match=f"{count} folds of 3 episodes"):
            fold_episodes(whole, count)


@pytest.mark.parametrize("column", [False, True])
def test_slices_stay_in_their_episode_however_ends_are_told(column):
    t = torch.arange(20)
    shape = (20, 1) if column else (20,)
    ways = [
        {"episode": (t // 5).reshape(shape)},
        {"next": {"truncated": (t % 5 == 4).reshape(shape)}},
        {"next": {"done": ((t == 9) | (t == 19)).reshape(shape), "truncated": ((t == 4) | (t == 14)).reshape(shape)}},
        {"is_init": (t % 5 == 0).reshape(shape)},
    ]
    keys = ["observation", "action"]
    orders = []
    for way in ways:
        rows = TensorDict({"observation": t[:, None].float(), "action": torch.rand(20, 1), **way}, [20])
        buffer = make_sequence_buffer(rows, slice_len=4, num_slices=2, keys=keys)
        seen = torch.cat([buffer.sample()["observation"][..., 0] for _ in range(8)])
        assert (seen[:, 0] // 5 == seen[:, -1] // 5).all()
        orders.append(seen)
    assert all(torch.equal(order, orders[0]) for order in orders)
