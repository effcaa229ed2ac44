"""Summaries of samples, censored durations and histograms against values worked by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ganlane.data import Bins, Histogram, describe, describe_durations, survival_curve


@given(st.lists(st.floats(-30.0, 30.0), min_size=2, max_size=300), st.integers(1, 5))
def test_a_histogram_describes_a_sample_to_a_bins_width(values, parts):
    histogram = Histogram(Bins(-20.0, 20.0, 400))
    for part in np.array_split(np.array(values), parts):
        histogram.add(part)
    found, exact = histogram.describe(), describe(values)
    assert (found.count, found.mean) == (exact.count, pytest.approx(exact.mean, abs=1e-9))
    assert found.sd == pytest.approx(exact.sd, abs=1e-5)
    ordered = np.clip(np.sort(values), -20.0, 20.0)
    for level, value in ((0.25, found.quantile(0.25)), (0.5, found.quantile(0.5)), (0.95, found.quantile(0.95))):
        # Between the neighbours of the exact place, and a bin's width more.
        at = level * len(ordered)
        low, high = ordered[max(int(np.floor(at)) - 1, 0)], ordered[min(int(np.ceil(at)), len(ordered) - 1)]
        assert low - 0.1 - 1e-9 <= value <= high + 0.1 + 1e-9


def test_a_histogram_of_nothing_says_nothing():
    assert Histogram(Bins(0.0, 1.0, 10)).describe() == describe([])


def test_the_survival_curve_takes_censored_times_as_lower_bounds():
    # Worked by hand: of 5, one ends at 1 (4/5 are left), one is cut off at 2, of the other 3 one ends at 3 (2/3 of
    # 4/5), one is cut off at 4, the last ends at 5.
    times, shares = survival_curve([3.0, 1.0, 2.0, 5.0, 4.0], [True, True, False, True, False])
    assert times.tolist() == [1.0, 3.0, 5.0]
    assert shares == pytest.approx([0.8, 0.8 * 2 / 3, 0.0])
    found = describe_durations([3.0, 1.0, 2.0, 5.0, 4.0], [True, True, False, True, False])
    assert found.survival_mean_s == pytest.approx(1.0 + 2 * 0.8 + 2 * 0.8 * 2 / 3)


def test_durations_cut_off_push_the_mean_up():
    # Kaplan and Meier by hand: ends at 1 and 3, cut off at 2. S = 1 until 1, 2/3 until 3, then 0.
    durations = describe_durations([1.0, 2.0, 3.0], [True, False, True])
    assert durations.survival_mean_s == pytest.approx(1.0 + 2.0 * 2.0 / 3.0)
    assert durations.survival_median_s == 3.0
    assert durations.complete.mean == pytest.approx(2.0)
    assert durations.complete.sd == pytest.approx(np.sqrt(2.0))
    assert (durations.complete.count, durations.censored) == (2, 1)


def test_durations_none_of_which_was_seen_whole_have_no_mean():
    durations = describe_durations([1.0, 2.0], [False, False])
    assert durations.censored == 2
    assert durations.survival_mean_s is None
    assert durations.complete.mean is None
    # One seen and a longer one cut off: the curve stays at one half or above after the last end.
    open_ended = describe_durations([1.0, 2.0, 2.5], [True, False, False])
    assert open_ended.survival_median_s is None
    assert open_ended.survival_mean_s == pytest.approx(1.0 + 1.5 * 2.0 / 3.0)


def test_a_sample_is_summed_up():
    summary = describe(np.arange(101.0))
    assert (summary.count, summary.mean) == (101, 50.0)
    assert summary.quantile(0.05) == pytest.approx(5.0)
    assert summary.quantile(0.5) == pytest.approx(50.0)
    assert describe([]).quantiles == ()
    assert describe([2.0]).sd is None
