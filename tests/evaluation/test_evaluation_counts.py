"""Exact intervals for counts against tables and SciPy."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from ganlane.evaluation.counts import clopper_pearson, poisson_interval, rate_per_1000_km


def test_no_crash_in_a_thousand_episodes_still_allows_some():
    estimate = clopper_pearson(0, 1000)
    assert estimate.low == 0.0
    assert estimate.high == pytest.approx(1 - 0.025 ** (1 / 1000))


def test_all_is_the_mirror_of_none():
    assert clopper_pearson(50, 50).interval == pytest.approx([0.025 ** (1 / 50), 1.0])


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_the_binomial_interval_agrees_with_scipy(data):
    trials = data.draw(st.integers(1, 2000))
    count = data.draw(st.integers(0, trials))
    theirs = stats.binomtest(count, trials).proportion_ci(0.95, "exact")
    assert clopper_pearson(count, trials).interval == pytest.approx([theirs.low, theirs.high], abs=1e-9)


@pytest.mark.parametrize(
    ("count", "low", "high"), [(0, 0.0, 3.689), (1, 0.025, 5.572), (5, 1.623, 11.668), (10, 4.795, 18.390)]
)
def test_the_poisson_interval_is_garwoods_table(count, low, high):
    assert poisson_interval(count).interval == pytest.approx([low, high], abs=1e-3)


def test_each_tail_of_the_poisson_interval_holds_two_and_a_half_percent():
    low, high = poisson_interval(7).interval
    at_least = 1 - sum(math.exp(-low) * low**k / math.factorial(k) for k in range(7))
    at_most = sum(math.exp(-high) * high**k / math.factorial(k) for k in range(8))
    assert (at_least, at_most) == pytest.approx((0.025, 0.025))


def test_crashes_are_related_to_a_thousand_kilometres():
    rate = rate_per_1000_km(5, 2_500_000.0)
    assert rate.value == pytest.approx(2.0)
    assert rate.interval == pytest.approx([1.623 / 2.5, 11.668 / 2.5], abs=1e-3)
    assert rate_per_1000_km(0, 0.0) is None
