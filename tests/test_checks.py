"""Numbers are checked in one place, by name, range and kind."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch

from torchrl_tsallis._checks import check_number


@pytest.mark.parametrize("value", [3, np.int32(3), torch.tensor(3), np.array([3])])
def test_whole_numbers_of_any_library_become_an_int(value):
    number = check_number("n", value, low=3, high=3, integer=True)
    assert number == 3 and type(number) is int


@pytest.mark.parametrize("value", [0.5, np.float32(0.5), torch.tensor([0.5])])
def test_numbers_of_any_library_become_a_float(value):
    number = check_number("x", value, above=0, below=1)
    assert number == 0.5 and type(number) is float


@pytest.mark.parametrize("value", [True, None, "3", 2.5, 2.0, 1j, [3], np.zeros(2), torch.zeros(0), np.bool_(True)])
def test_what_is_no_whole_number_is_named(value):
    with pytest.raises(TypeError, match=r"^steps must be an integer of at least 1, got " + re.escape(repr(value))):
        check_number("steps", value, low=1, integer=True)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 0, -1, 1, 2, np.float64("nan")])
def test_what_is_outside_of_its_range_is_named(value):
    with pytest.raises(ValueError, match=r"^q must be a finite number above 0 and below 1, got "):
        check_number("q", value, above=0, below=1)


def test_infinity_can_be_allowed_but_nan_cannot():
    assert check_number("limit", float("inf"), above=0, finite=False) == float("inf")
    with pytest.raises(ValueError, match="limit must be a number above 0, got nan"):
        check_number("limit", float("nan"), above=0, finite=False)


def test_a_number_too_large_for_a_float_is_compared_as_it_is():
    assert check_number("seed", 2**80, low=0, integer=True) == 2**80
    with pytest.raises(ValueError, match="of at most"):
        check_number("seed", 2**1100, high=10, integer=True)
    with pytest.raises(ValueError, match="x must be a finite number"):
        check_number("x", 2**1100)
