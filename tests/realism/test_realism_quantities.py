"""What is measured of trajectories, on trajectories worked out by hand."""

import numpy as np
import pytest

from ganlane.realism.quantities import QUANTITIES, measure
from ganlane.realism.recordings import Recording, recorded_frame, segments


def recording(x, y=None, name="scene", lanes=3, present=None):
    """Cars of 4 m on lanes of 3.5 m; ``x`` [T, V]."""
    x = np.asarray(x, dtype=np.float64)
    y = np.zeros_like(x) if y is None else np.asarray(y, dtype=np.float64)
    present = np.ones(x.shape, bool) if present is None else present
    size = np.ones(x.shape[1])
    return Recording(name, name, lanes, 3.5, x, y, np.zeros_like(x), present, 4.0 * size, 2.0 * size, size > 0)


def measured(*recordings):
    return measure(recorded_frame(recordings), sorted(each.name for each in recordings))


def values(result, quantity):
    return result.samples[quantity]["value"].to_numpy()


TIME = np.arange(100)[:, None] * 0.1


def test_constant_acceleration_shows_as_it_is_and_has_no_jerk():
    result = measured(recording(10.0 * TIME + 0.5 * 0.8 * TIME**2))
    assert values(result, "acceleration") == pytest.approx(0.8)
    assert values(result, "jerk") == pytest.approx(0.0, abs=1e-9)


def test_a_cubic_path_has_its_jerk_and_speed_of_the_second():
    result = measured(recording(10.0 * TIME + 0.3 * TIME**3 / 6.0))
    assert values(result, "jerk") == pytest.approx(0.3)
    # Mean over the second about t: 10 + 0.3 t^2 / 2 + 0.3 / 24.
    t = TIME[30:95, 0]
    assert values(result, "speed") == pytest.approx(10.0 + 0.15 * t**2 + 0.3 / 24.0)


def test_the_first_three_seconds_of_a_vehicle_do_not_count():
    present = np.ones((100, 2), bool)
    present[:50, 1] = False
    result = measured(recording(np.hstack([20.0 * TIME, 20.0 * TIME + 30.0]), present=present))
    # The first: samples 30 to 94. The second appears at 50: samples 80 to 94.
    assert len(values(result, "speed")) == 65 + 15
    assert result.vehicle_km == pytest.approx((70 + 20) * 2.0 / 1000.0)


def test_gap_headway_and_time_to_collision_of_two_cars():
    result = measured(recording(np.hstack([12.0 * TIME, 64.0 + 10.0 * TIME])))
    t = TIME[30:95, 0]
    gap = 60.0 - 2.0 * t
    assert values(result, "gap") == pytest.approx(gap)
    assert values(result, "time_headway") == pytest.approx(gap / 12.0)
    assert values(result, "time_to_collision") == pytest.approx(gap / 2.0)


def test_cars_in_different_lanes_do_not_follow_each_other():
    beside = np.hstack([np.zeros_like(TIME), np.full_like(TIME, 3.5)])
    result = measured(recording(np.hstack([12.0 * TIME, 64.0 + 10.0 * TIME]), beside))
    assert len(values(result, "gap")) == 0
    assert result.quantile("gap", 0.5) is None


def test_spread_of_speeds_is_that_within_a_frame():
    x = np.hstack([(10.0 + 2.0 * k) * TIME + 40.0 * k for k in range(3)])
    assert values(measured(recording(x)), "speed_spread") == pytest.approx(2.0)
    assert len(values(measured(recording(x[:, :2])), "speed_spread")) == 0


def test_a_lane_change_counts_once_with_its_duration_unless_it_comes_too_early():
    for start, expected in ((4.0, 1), (0.2, 0)):
        part = np.clip((TIME - start) / 4.0, 0.0, 1.0)
        y = 3.5 * 0.5 * (1.0 - np.cos(np.pi * part))
        result = measured(recording(20.0 * TIME, y))
        assert result.lane_changes == expected
        if expected:
            assert 2.0 < values(result, "lane_change_duration")[0] < 4.0


def test_histograms_keep_scenes_apart_and_everything_in_the_outermost_bins():
    slow, fast = recording(10.5 * TIME, name="slow"), recording(55.0 * TIME, name="fast")
    counts = measured(slow, fast).counts["speed"]
    assert counts.shape == (2, QUANTITIES["speed"].number)
    assert counts[0, -1] == counts[0].sum() == 65
    assert counts[1, 10] == counts[1].sum() == 65


def test_vehicles_that_are_replayed_are_led_by_but_not_measured():
    pair = recording(np.hstack([12.0 * TIME, 64.0 + 10.0 * TIME]))
    led = Recording(**{**vars(pair), "driven": np.array([True, False])})
    assert len(values(measured(led), "speed")) == 65
    assert len(values(measured(led), "gap")) == 65


def test_segments_keep_their_unit_and_leave_out_what_was_to_be_skipped():
    pieces = segments(recording(10.0 * TIME), 3.0, skip_s=3.5)
    assert [piece.name for piece in pieces] == ["scene@35", "scene@65"]
    assert {piece.unit for piece in pieces} == {"scene"}
    assert pieces[1].x[0, 0] == pytest.approx(65.0)
