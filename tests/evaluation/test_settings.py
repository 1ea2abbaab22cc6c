"""Settings are refused before anything runs."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from torchrl_tsallis.evaluation import evaluate_policies, record_rollout
from torchrl_tsallis.evaluation.settings import positive_number, whole_number

NO_NUMBERS = [-1, 2.5, float("nan"), float("inf"), True, "3", None, np.float64(2.0), [1]]


def never():
    raise AssertionError("the environment was made")


@pytest.mark.parametrize("value", NO_NUMBERS)
@pytest.mark.parametrize("name", ["episodes", "seed", "workers", "max_steps", "retries"])
def test_numbers_that_are_not_whole_are_refused_in_one_line(name, value):
    with pytest.raises(ValueError, match=f"^{name} must be a whole number of at least [01], got {name}=.*$"):
        evaluate_policies({"p": np.zeros_like}, env_fn=never, **{name: value})


@pytest.mark.parametrize("name", ["episodes", "max_steps"])
def test_zero_of_what_must_be_at_least_one(name):
    with pytest.raises(ValueError, match=f"{name} must be a whole number of at least 1, got {name}=0"):
        evaluate_policies({"p": np.zeros_like}, env_fn=never, **{name: 0})


@pytest.mark.parametrize("value", [0, -1.0, float("nan"), float("inf"), True, "3", None])
@pytest.mark.parametrize("name", ["seconds", "fps", "step_seconds"])
def test_numbers_of_a_video_are_refused_in_one_line(name, value, tmp_path):
    if (name, value) == ("step_seconds", None):
        return
    with pytest.raises(ValueError, match=f"^{name} must be a positive number, got {name}=.*$"):
        record_rollout(np.zeros_like, tmp_path / "a.gif", env_fn=never, **{name: value})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"size": (8, 64)}, "width must be a whole number of at least 16"),
        ({"size": (64, 64.5)}, "height must be"),
        ({"size": 64}, "size must be"),
        ({"size": (64, 64, 3)}, "size must be"),
        ({"seed": -1}, "seed must be"),
        ({"fps": 101}, "at most 100 frames"),
    ],
)
def test_other_settings_of_a_video(settings, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        record_rollout(np.zeros_like, tmp_path / "a.gif", env_fn=never, **settings)
    assert not list(tmp_path.iterdir())


def test_what_makes_no_environment_is_refused_before_a_process_starts():
    for env_fn, message in (
        ("Ant-v5", r"use functools.partial\(gymnasium.make, 'Ant-v5'\)"),
        ("module:", "module:function"),
        (":function", "module:function"),
        (object(), "callable that makes the environment, got a object"),
        (None, "got a NoneType"),
    ):
        with pytest.raises((ValueError, TypeError), match=message):
            evaluate_policies({"p": np.zeros_like}, env_fn=env_fn)
    for env_fn in (lambda: None, partial(lambda x: x, 1)):
        with pytest.raises(ValueError, match="env_fn cannot be pickled.*or use workers=0"):
            evaluate_policies({"p": np.zeros_like}, env_fn=env_fn, progress=False)


def test_numpy_s_whole_numbers_are_numbers():
    assert whole_number("n", np.int32(3), 1) == 3 and type(whole_number("n", np.int32(3), 1)) is int
    assert positive_number("x", np.float32(0.5)) == 0.5
