"""When a rating gives no verdict, and what the verdict says: numbers by hand."""

from __future__ import annotations

import json

import numpy as np
import pytest

from torchrl_tsallis.runs.judgement import agreement, interval, judge, reliability, verdict

NAMES = [f"demo_{k}" for k in range(10)]
GOOD = np.array([[1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.7, 1.8, 9.0]] * 3) + 0.01 * np.arange(3)[:, None]
#: 1000 samples of a calibrated surprise: its decades are minus the logarithm of a uniform number.
SAMPLES = np.broadcast_to(-np.log10((np.arange(1000) + 0.5) / 1000), (3, 1000))
RATING = np.where(SAMPLES > 2, 0.1, 1.0)


def said(by_seed=GOOD, surprise=SAMPLES, rating=RATING, stretch=(1.0, 1.2), names=NAMES):
    found = judge(names, by_seed, surprise, rating, stretch)
    json.dumps(found, allow_nan=False)
    assert found["usable"] == (not found["reasons"])
    assert found["sentence"].startswith("No verdict: ") == (not found["usable"])
    return found


def test_seeds_that_agree_and_are_calibrated_give_a_verdict():
    found = said()
    assert found["usable"] and found["sentence"].startswith("Look first at demo_9: 1 of 10 episodes is")
    assert found["calibration"] == {"1": 0.1, "2": 0.01, "3": 0.001}
    assert found["agreement"]["spearman"] == 1.0


def shuffled():
    rng = np.random.default_rng(0)
    return np.stack([rng.permutation(GOOD[0]) for _ in range(3)])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"by_seed": shuffled()}, "the seeds agree neither on the order"),
        ({"by_seed": GOOD[:1]}, "one seed cannot be compared"),
        ({"by_seed": GOOD[:, :7], "names": NAMES[:7]}, "7 episodes are too few: at least 8"),
        ({"stretch": (9.1, 12.0, 1.0)}, "squared errors are 9.1 times"),
        ({"surprise": SAMPLES + 1}, "not calibrated on held-out episodes: 100 %"),
        ({"surprise": SAMPLES / 9}, "not calibrated on held-out episodes: 0 %"),
        ({"surprise": SAMPLES.clip(max=2.5), "rating": RATING * 0 + 0.95}, "all ratings are near 1"),
    ],
)
def test_each_reason_alone_takes_the_verdict(change, reason):
    found = said(**change)
    assert len(found["reasons"]) == 1 and reason in found["reasons"][0]


def test_good_episodes_in_any_order_do_not_hide_two_that_are_bad():
    rng = np.random.default_rng(0)
    alike = rng.uniform(0.2, 0.5, (3, 8))
    by_seed = np.concatenate([alike, np.full((3, 2), 11.0) + 0.1 * rng.normal(size=(3, 2))], 1)
    assert agreement(by_seed)["spearman"] < 0.5 < 0.9 < reliability(by_seed)
    assert "2 of 10 episodes are" in said(by_seed)["sentence"]


def test_one_seed_alone_names_no_episode():
    by_seed = np.ones((3, 10)) + 0.01 * np.arange(10)
    by_seed[0, 4] = 12.0
    assert reliability(by_seed) < 0.5
    assert verdict(NAMES, by_seed).startswith("No episode stands out")


def test_reliability_and_interval_by_hand():
    values = np.array([[0.0, 4.0], [2.0, 4.0]])  # means 1 and 4; between 2 * 4.5 = 9, within 2 / 2 = 1
    assert reliability(values) == pytest.approx((9 - 1) / (9 + 1))
    assert reliability(np.ones((2, 3))) == 0.0 and reliability(values[:1]) is None
    low, high = interval(np.array([[1.0], [2.0], [3.0]]))  # 2 +- 4.303 / sqrt(3)
    np.testing.assert_allclose([low[0], high[0]], [0.0, 2 + 4.303 / 3**0.5])
    assert np.isnan(interval(values[:1])).all()
