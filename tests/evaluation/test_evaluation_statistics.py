"""Bootstrap intervals against closed forms, SciPy and hand-worked values."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from ganlane.evaluation.statistics import (
    bootstrap_means,
    interquartile_mean,
    mean_interval,
    paired_difference,
    probability_of_improvement,
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


def test_the_bootstrapped_mean_spreads_like_the_standard_error(skewed):
    means = bootstrap_means(skewed, 10_000, seed=0)
    assert means.std() == pytest.approx(skewed.std() / np.sqrt(len(skewed)), rel=0.03)


@pytest.mark.parametrize("method", ["percentile", "bca"])
def test_the_interval_agrees_with_scipy(skewed, method):
    ours = mean_interval(skewed, method)
    theirs = stats.bootstrap(
        (skewed,), np.mean, n_resamples=10_000, method=method.replace("bca", "BCa"), random_state=5
    ).confidence_interval
    width = theirs.high - theirs.low
    assert ours.value == pytest.approx(skewed.mean())
    assert ours.low == pytest.approx(theirs.low, abs=0.04 * width)
    assert ours.high == pytest.approx(theirs.high, abs=0.04 * width)


def test_bca_leans_towards_the_long_tail(skewed):
    percentile, bca = mean_interval(skewed, "percentile"), mean_interval(skewed, "bca")
    assert bca.low < percentile.low
    assert bca.high < percentile.high


def test_the_same_seed_gives_the_same_interval(skewed):
    assert mean_interval(skewed, seed=4) == mean_interval(skewed, seed=4)
    assert mean_interval(skewed, seed=4) != mean_interval(skewed, seed=5)


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


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=40))
def test_the_interquartile_mean_is_the_trimmed_mean(values):
    expected = stats.trim_mean(values, 0.25)
    assert interquartile_mean(values, resamples=10).value == pytest.approx(expected, abs=1e-9)


def test_the_interquartile_mean_ignores_rare_crashes(skewed):
    estimate = interquartile_mean(skewed, resamples=2000)
    assert estimate.low < estimate.value < estimate.high
    assert estimate.value > 255 > skewed.mean()


def test_the_probability_of_improvement_counts_pairs():
    # Of the six pairs 2 beats 1 twice and ties once, 3 wins all three: (2 + 0.5 + 3) / 6.
    assert probability_of_improvement([2.0, 3.0], [1.0, 1.0, 2.0]).value == pytest.approx(5.5 / 6)


def test_the_probability_of_improvement_is_mann_whitneys_u(skewed):
    other = skewed[:90] + 4.0
    estimate = probability_of_improvement(other, skewed)
    u = stats.mannwhitneyu(other, skewed).statistic
    assert estimate.value == pytest.approx(u / (len(other) * len(skewed)))
    assert estimate.low < estimate.value < estimate.high
    # The bootstrap's spread against the usual standard error of U under no difference.
    a, b = len(other), len(skewed)
    expected = 2 * 1.96 * np.sqrt((a + b + 1) / (12 * a * b))
    assert estimate.high - estimate.low == pytest.approx(expected, rel=0.15)
