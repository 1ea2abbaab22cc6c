from __future__ import annotations

import numpy as np
import pytest

from torchrl_tsallis.evaluation.statistics import (
    auroc,
    bootstrap_interval,
    improvement_interval,
    iqm,
    median,
    probability_of_improvement,
)


def test_median_by_hand():
    assert median([[4.0, 1.0], [10.0, 2.0]]) == 3.0


def test_iqm_by_hand():
    assert iqm([7.0, 1.0, 3.0, 5.0, 0.0, 8.0, 100.0, -50.0]) == pytest.approx((1 + 3 + 5 + 7) / 4)
    # six entries: a quarter is 1.5 entries, so the second and fifth count half
    assert iqm([0.0, 1.0, 2.0, 4.0, 9.0, 50.0]) == pytest.approx((0.5 * 1 + 2 + 4 + 0.5 * 9) / 3)
    assert iqm([3.0]) == pytest.approx(3.0)


def test_interval_keeps_a_seed_together():
    # Two seeds whose episodes differ by +-1: the mean of a draw is 0, 5 or 10, never between.
    seen = set()

    def mean(x):
        seen.add(float(x.mean()))
        return float(x.mean())

    result = bootstrap_interval([[-1.0, 1.0], [9.0, 11.0]], mean)
    assert seen == {0.0, 5.0, 10.0}
    assert result == {"value": 5.0, "low": 0.0, "high": 10.0, "unit": "seed", "n": 2}


def test_interval_is_stratified_by_task():
    # Drawing seeds inside each constant task changes nothing; pooled draws would.
    scores = np.stack([np.zeros((3, 2)), np.full((3, 2), 8.0)])
    result = bootstrap_interval(scores, lambda x: float(x.mean()))
    assert (result["low"], result["value"], result["high"]) == (4.0, 4.0, 4.0)


def test_one_seed_falls_back_to_episodes():
    result = bootstrap_interval([[0.0, 10.0]], lambda x: float(x.mean()))
    assert result == {"value": 5.0, "low": 0.0, "high": 10.0, "unit": "episode", "n": 2}


def test_interval_repeats_with_its_seed():
    scores = np.random.default_rng(1).normal(size=(6, 4))
    assert bootstrap_interval(scores, seed=3) == bootstrap_interval(scores, seed=3)
    assert bootstrap_interval(scores, seed=3) != bootstrap_interval(scores, seed=4)


def test_auroc_by_hand_and_brute_force():
    assert auroc([2.0, 3.0], [0.0, 1.0]) == 1.0
    assert auroc([0.0], [1.0, 2.0]) == 0.0
    assert auroc([1.0, 1.0], [1.0]) == 0.5
    rng = np.random.default_rng(0)
    a, b = rng.integers(0, 6, 40), rng.integers(0, 5, 30)
    brute = np.mean((a[:, None] > b) + 0.5 * (a[:, None] == b))
    assert auroc(a, b) == pytest.approx(brute)


def test_probability_of_improvement_by_hand():
    assert probability_of_improvement([1.0, 4.0], [2.0, 1.0]) == (0 + 0.5 + 1 + 1) / 4
    with pytest.raises(ValueError, match="reduce over episodes"):
        probability_of_improvement([[1.0]], [1.0])


@pytest.mark.parametrize("function", [median, iqm, bootstrap_interval, lambda x: auroc(x, [1.0])])
def test_empty_and_nan(function):
    with pytest.raises(ValueError, match="empty"):
        function([])
    with pytest.raises(ValueError, match=r"NaN at index \(1,\)"):
        function([1.0, float("nan")])


def test_ragged():
    with pytest.raises(ValueError, match="rectangular"):
        median([[1.0], [1.0, 2.0]])


def test_improvement_and_its_interval():
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 6, 9).astype(float), rng.integers(0, 5, 7).astype(float)
    result = improvement_interval(x, y)
    assert result["value"] == pytest.approx(probability_of_improvement(x, y))
    assert 0 <= result["low"] < result["value"] < result["high"] <= 1
    assert result == improvement_interval(x, y, seed=0) != improvement_interval(x, y, seed=1)
    # Two seeds against one: a draw has both, or one of them twice.
    result = improvement_interval([0.0, 2.0], [1.0])
    assert result == {"value": 0.5, "low": 0.0, "high": 1.0}


def test_improvement_is_stratified_by_task_and_averages_them():
    x, y = [[1.0, 1.0], [0.0, 0.0]], [[0.0, 0.0, 0.0], [5.0, 5.0, 5.0]]  # better on one task, worse on the other
    assert improvement_interval(x, y) == {"value": 0.5, "low": 0.5, "high": 0.5}
    with pytest.raises(ValueError, match="as many tasks"):
        improvement_interval(x, y[0])
    with pytest.raises(ValueError, match="resamples=0"):
        improvement_interval(x, y, resamples=0)
