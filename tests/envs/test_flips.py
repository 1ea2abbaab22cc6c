from __future__ import annotations

import numpy as np
import pytest

from torchrl_tsallis.envs.flips import TURNED, count_flips


def history(*turns, steps=200, pages=4):
    """Pages that lie at 0 rad, and at 3 rad within [begin, end) of each turn (page, begin, end)."""
    angles = np.zeros((steps, pages))
    for page, begin, end in turns:
        angles[begin:end, page] = 3.0
    return angles


def test_nothing_moves():
    flips = count_flips(history())
    assert flips.total == flips.singles == flips.multiples == 0
    assert len(flips.sizes) == 0


def test_singles_in_order():
    flips = count_flips(history((2, 90, None), (3, 40, None)))
    assert flips.pages.tolist() == [3, 2]
    assert flips.steps.tolist() == [40, 90]
    assert flips.sizes.tolist() == [1, 1]


def test_a_double_counts_as_two_pages_and_one_event():
    flips = count_flips(history((3, 40, None), (2, 50, None)))
    assert (flips.total, flips.singles, flips.multiples) == (2, 0, 1)


def test_the_window_begins_at_the_first_page():
    flips = count_flips(history((3, 40, None), (2, 70, None), (1, 71, None)))  # 0.60 s and 0.62 s later
    assert flips.sizes.tolist() == [2, 1]
    assert flips.events.tolist() == [0, 0, 1]


def test_a_page_must_stay_for_half_a_second():
    assert count_flips(history((3, 40, 65))).total == 0  # 25 steps beyond: back again 0.5 s later
    assert count_flips(history((3, 40, 66))).total == 1


def test_the_end_counts():
    assert count_flips(history((3, 198, None))).total == 1


def test_back_and_again_counts_again():
    flips = count_flips(history((3, 20, 30), (3, 40, 100), (3, 150, None)))
    assert flips.steps.tolist() == [40, 150]


def test_threshold():
    angles = np.zeros((50, 1))
    angles[10:] = TURNED
    assert count_flips(angles).total == 0
    angles[10:] = np.nextafter(TURNED, 4.0)
    assert count_flips(angles).total == 1


def test_pages_that_start_turned_do_not_count():
    assert count_flips(np.full((50, 2), 3.0)).total == 0


@pytest.mark.parametrize("bad", [np.zeros(5), np.full((5, 2), np.nan)])
def test_refuses(bad):
    with pytest.raises(ValueError, match="finite history"):
        count_flips(bad)
