"""Lane widths, and the lane-change detector and equation 11 on tracks made by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ganlane.data import Tracks
from ganlane.data.lanes import find_lane_changes, lane_width


@settings(max_examples=30)
@given(width=st.floats(3.0, 4.0), seed=st.integers(0, 10_000))
def test_lane_keepers_tell_the_width_to_a_few_centimetres(width, seed):
    random = np.random.default_rng(seed)
    lane = random.permutation(np.arange(400) % 4)
    y = lane * width + random.normal(0.0, 0.2, lane.size)
    nearest = np.rint(y / width).astype(np.int64)
    assert lane_width(y, nearest) == pytest.approx(width, abs=0.06)


def test_a_single_lane_gets_the_standard_width_and_one_stray_row_does_not_make_a_lane():
    assert lane_width(np.linspace(-0.3, 0.3, 20), np.zeros(20, np.int64)) == 3.66
    # Fewer rows than half a second of one vehicle.
    y = np.concatenate((np.zeros(50), np.full(50, 3.5), [30.0]))
    lane = np.concatenate((np.zeros(50), np.ones(50), [5])).astype(np.int64)
    assert lane_width(y, lane) == pytest.approx(3.5)


WIDTH = 3.6
#: Keeps lane 0, moves left at 1 m/s from 2.05 s to 5.65 s, keeps lane 1.
RAMP = np.clip(np.arange(80) * 0.1 - 2.05, 0.0, WIDTH)


def changes_of(y):
    """The lane changes of one track."""
    return find_lane_changes(Tracks(y, np.full(len(y), WIDTH), np.arange(len(y)) == 0))


def test_a_ramp_is_timed_from_and_to_three_tenths_off_the_centres():
    # The boundary, 1.8 m, is crossed at 3.85 s. Going back, 2.3 s is the first sample within 0.3 m
    # of the old centre (0.25 m); going on, 5.4 s is the first within 0.3 m of the new one (3.35 m).
    change = changes_of(RAMP)
    assert (change.old_lane[0], change.new_lane[0], change.sample[0]) == (0, 1, 38)
    times = change.tau_s[0], change.tau_e[0], change.duration_s[0]
    assert times == pytest.approx((1.55, 1.55, 3.1))
    assert change.lateral_speed[0] == pytest.approx(1.0)
    assert change.complete[0]


def test_a_driver_who_stops_beside_the_centre_has_ended_the_change():
    # Stops at 2.68 m. Over 1 s about 5.1 s it moves 0.13 m, about 5.2 s 0.03 m: the change ends at
    # 5.2 s.
    change = changes_of(np.minimum(RAMP, 2.68))
    assert change.tau_e[0] == pytest.approx(5.2 - 3.85)
    assert change.lateral_speed[0] == pytest.approx((2.68 - 0.25) / (5.2 - 2.3))


def test_a_track_that_ends_in_the_middle_of_the_change_is_censored():
    early = changes_of(RAMP[:45])
    late = changes_of(RAMP[33:])
    assert [(change.start_censored[0], change.end_censored[0]) for change in (early, late)] == [
        (False, True),
        (True, False),
    ]
    assert (early.tau_e[0], late.tau_s[0]) == pytest.approx((4.4 - 3.85, 3.85 - 3.3))
    assert not late.complete[0]


@pytest.mark.parametrize(("samples", "changes"), [(4, 0), (5, 1)])
def test_a_lane_must_be_seen_for_half_a_second(samples, changes):
    # 0.1 m off the boundary, on one side and on the other.
    long, short = np.full(20, 1.7), np.full(samples, 1.9)
    assert len(changes_of(np.r_[long, short])) == changes
    assert len(changes_of(np.r_[short, long])) == changes
    assert len(changes_of(np.r_[long, short, long])) == 2 * changes
