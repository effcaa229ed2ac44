"""Intervals against closed forms, SciPy, tables and hand-worked values."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from ganlane.evaluation.statistics import (
    Estimate,
    clopper_pearson,
    entries,
    mean_interval,
    paired_difference,
    poisson_interval,
    resample_counts,
)


@pytest.fixture
def skewed():
    """Returns as they look here: most near 260, a few crashes far below."""
    generator = np.random.default_rng(3)
    return np.where(generator.random(200) < 0.08, -20.0, 260.0) + generator.normal(0, 20, 200)


def test_a_resample_draws_as_many_episodes_as_there_are():
    counts = np.concatenate(list(resample_counts(7, 1200, seed=1)))
    assert counts.shape == (1200, 7)
    assert np.all(counts.sum(axis=1) == 7)
    assert counts.mean(axis=0) == pytest.approx(np.ones(7), abs=0.15)


def test_the_interval_is_scipys_bca_and_repeats_with_its_seed(skewed):
    ours = mean_interval(skewed)
    theirs = stats.bootstrap((skewed,), np.mean, n_resamples=10_000, method="BCa", random_state=5).confidence_interval
    width = theirs.high - theirs.low
    assert ours.value == pytest.approx(skewed.mean())
    assert ours.interval == pytest.approx([theirs.low, theirs.high], abs=0.04 * width)
    assert mean_interval(skewed, seed=4) == mean_interval(skewed, seed=4) != mean_interval(skewed, seed=5)


def test_the_95_percent_interval_covers_the_mean_about_95_times_in_a_hundred():
    generator = np.random.default_rng(0)
    samples = generator.exponential(1.0, (300, 60))
    intervals = [mean_interval(sample, resamples=1000, seed=i) for i, sample in enumerate(samples)]
    covered = np.mean([interval.low <= 1.0 <= interval.high for interval in intervals])
    assert 0.90 <= covered <= 0.98


def test_one_value_has_no_interval_and_equal_values_have_an_empty_one():
    assert mean_interval([3.0]).interval is None
    assert mean_interval([3.0, 3.0, 3.0]).interval == [3.0, 3.0]
    assert not mean_interval([3.0]).excludes_zero()


def test_a_rows_entries_are_none_where_there_is_no_number():
    assert entries("rate", Estimate(2.0, 1.0, 3.0)) == {"rate": 2.0, "rate_ci": [1.0, 3.0]}
    assert entries("rate", None) == entries("rate", Estimate(float("nan"))) == {"rate": None, "rate_ci": None}


def test_pairing_removes_what_the_episodes_have_in_common():
    generator = np.random.default_rng(1)
    common = generator.normal(0, 100, 100)
    better = common + 5 + generator.normal(0, 1, 100)
    difference = paired_difference(better, common)
    assert difference.excludes_zero()
    assert difference.low < 5 < difference.high
    assert difference.high - difference.low < 1.0
    with pytest.raises(ValueError, match="shape"):
        paired_difference(common, common[1:])


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_the_binomial_interval_agrees_with_scipy(data):
    trials = data.draw(st.integers(1, 2000))
    count = data.draw(st.integers(0, trials))
    theirs = stats.binomtest(count, trials).proportion_ci(0.95, "exact")
    assert clopper_pearson(count, trials).interval == pytest.approx([theirs.low, theirs.high], abs=1e-9)


@pytest.mark.parametrize(("count", "bounds"), [(0, [0.0, 1 - 0.025 ** (1 / 50)]), (50, [0.025 ** (1 / 50), 1.0])])
def test_none_and_all_of_fifty_have_bounds_in_closed_form(count, bounds):
    assert clopper_pearson(count, 50).interval == pytest.approx(bounds)


@pytest.mark.parametrize(
    ("count", "low", "high"), [(0, 0.0, 3.689), (1, 0.025, 5.572), (5, 1.623, 11.668), (10, 4.795, 18.390)]
)
def test_the_poisson_interval_is_garwoods_table(count, low, high):
    assert poisson_interval(count).interval == pytest.approx([low, high], abs=1e-3)


def test_an_estimate_is_scaled_with_its_bounds():
    rate = poisson_interval(5).scaled(1000.0, per=2500.0)
    assert rate.value == pytest.approx(2.0)
    assert rate.interval == pytest.approx([1.623 / 2.5, 11.668 / 2.5], abs=1e-3)
    assert Estimate(4.0).scaled(0.5) == Estimate(2.0)
