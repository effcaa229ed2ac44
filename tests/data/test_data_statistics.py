"""Statistics against values worked by hand, and the figures published with the US-101 recordings,
where they are.
"""

import json

import numpy as np
import polars as pl
import pytest
from reference.refusals import user_error
from reference.synthetic import synthetic_scenes

from ganlane.data import SCHEMA, tracks_of_frame
from ganlane.data.lanes import find_lane_changes
from ganlane.data.statistics import (
    DrivingStatistics,
    describe_durations,
    driving_statistics,
    quantities,
    survival_curve,
)


def track(vehicle, x, lane=0, y=None):
    """One vehicle at positions ``x``, a sample every 0.1 s; its speed is the forward difference."""
    y = np.full(len(x), 3.5 * lane) if y is None else y
    columns = {
        "scene": "s",
        "vehicle": vehicle,
        "frame": np.arange(len(x)),
        "x": x,
        "y": y,
        "speed": np.gradient(x, 0.1),
        "lane": np.rint(y / 3.5),
        "length": 4.0,
        "width": 2.0,
    }
    return pl.DataFrame(columns, schema=SCHEMA, strict=False)


def accelerations(frame):
    measured = quantities(frame)
    return measured["acceleration_raw"].tolist(), measured["acceleration_smoothed"].tolist()


def test_a_steady_acceleration_is_found_by_either_measure_and_a_lost_frame_splits_a_track():
    time = np.arange(50) * 0.1
    frame = track(1, 10.0 * time + 0.75 * time**2)
    raw, smoothed = accelerations(frame)
    assert smoothed == pytest.approx([1.5] * 30)
    # numpy's gradient is one-sided at both ends.
    assert raw[1:-1] == pytest.approx([1.5] * 47)
    raw, smoothed = accelerations(frame.filter(pl.col("frame") != 25))
    # Frames 20 to 24 and 46 to 49 have two seconds without a gap behind them.
    assert smoothed == pytest.approx([1.5] * 9)
    assert len(raw) == 49 - 2


def test_noise_from_frame_to_frame_is_smoothed_away():
    time = np.arange(100) * 0.1
    # 5 cm of noise in the position, 1 m/s in the speed.
    noisy = track(1, 10.0 * time + 0.05 * (-1.0) ** np.arange(100))
    raw, smoothed = accelerations(noisy.with_columns(speed=10.0 + pl.col("frame") % 2))
    assert np.abs(smoothed).max() == pytest.approx(0.0, abs=1e-9)
    assert np.abs(raw).min() == pytest.approx(10.0)


def test_the_headway_is_the_followers_own():
    time = np.arange(20) * 0.1
    leader = track(1, 26.0 + 10.0 * time)
    follower = track(2, 10.0 * time)  # gap 22 m at 10 m/s: (22 - 2) / 10 = 2 s
    beside = track(3, 13.0 + 10.0 * time, lane=1)
    (headway,) = quantities(pl.concat((leader, follower, beside)))["headway"]
    assert headway == pytest.approx(2.0)
    # Neither a leader further away nor a meeting of less than a second counts.
    far = track(1, 100.0 + 10.0 * time)
    short = pl.concat((leader, follower)).filter(pl.col("frame") < 9)
    for without in (pl.concat((far, follower)), short):
        assert len(quantities(without)["headway"]) == 0


def recording():
    """Three cars of 20 m/s on 500 m; one changes lanes; one comes in two tracks of 100 m."""
    time = np.arange(251) * 0.1
    # From lane 0 to lane 1 at 1 m/s.
    moves = np.clip(time - 10.05, 0.0, 3.5)
    one = track(1, 20.0 * time, y=moves)
    other = track(2, 20.0 * time, lane=1)
    early = track(3, 20.0 * time[:51], lane=2)
    late = track(10_003, 20.0 * time[:51] + 400.0, lane=2).with_columns(pl.col("frame") + 200)
    return pl.concat((one, other, early, late))


def test_a_recording_is_measured_as_by_hand():
    measured = driving_statistics(recording())
    exposure = measured.exposure
    changes = measured.lane_changes
    assert (exposure.scenes, exposure.tracks, exposure.cars, exposure.samples) == (1, 4, 3, 604)
    assert exposure.road_m == pytest.approx(500.0)
    # Straight: 500 + 500 + 100 + 100 m; the change adds 3.5 s of sqrt(20^2 + 1) less 20 m/s, 0.09
    # m.
    assert exposure.vehicle_km == pytest.approx(1.2001, abs=1e-4)
    assert changes.count == 1
    assert changes.srlc == pytest.approx(1 / 3 * 1000 / 500)
    assert changes.per_vehicle_km == pytest.approx(1 / 1.2, rel=1e-3)
    # Garwood's bounds for one event, as tabled in textbooks of epidemiology.
    bounds = (changes.per_vehicle_km_low, changes.per_vehicle_km_high)
    assert bounds == pytest.approx((0.0253 / 1.2, 5.572 / 1.2), rel=1e-2)
    assert changes.t_m_srlc_steps == pytest.approx(750.0)
    assert changes.t_m_vehicle_km_steps == pytest.approx(600.0, rel=1e-3)
    assert changes.duration.complete.count == 1
    assert changes.lateral_speed.mean == pytest.approx(1.0)
    assert measured.speed.mean == pytest.approx(20.0)
    assert measured.speed_sd_in_frame == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("frame", [recording(), synthetic_scenes(scenes=1, vehicles=1)])
def test_statistics_survive_json(frame):
    measured = driving_statistics(frame)
    stored = json.dumps(measured.to_dict(), allow_nan=False)
    assert DrivingStatistics.from_dict(json.loads(stored)) == measured


def test_foreign_statistics_are_refused():
    numbers = driving_statistics(recording()).to_dict()
    # One name is missing, then nearly all.
    del numbers["lane_changes"]["srlc"]
    with user_error("srlc"):
        DrivingStatistics.from_dict(numbers)
    with user_error("measure them again"):
        DrivingStatistics.from_dict({"speed": 3})


def test_a_lone_lane_keeper_leaves_the_rest_open():
    measured = driving_statistics(synthetic_scenes(scenes=1, vehicles=1, changing_share=0.0))
    changes = measured.lane_changes
    assert (changes.count, changes.t_m_srlc_steps, changes.per_vehicle_km_low) == (0, None, 0.0)
    assert changes.per_vehicle_km_high > 0.0
    assert (measured.headway.count, measured.speed_sd_in_frame) == (0, None)


def test_the_survival_curve_takes_censored_times_as_lower_bounds():
    # Worked by hand: of 5, one ends at 1 (4/5 are left), one is cut off at 2, of the other 3 one
    # ends at 3 (2/3 of 4/5), one is cut off at 4, the last ends at 5.
    durations = np.array([3.0, 1.0, 2.0, 5.0, 4.0]), np.array([True, True, False, True, False])
    times, shares = survival_curve(*durations)
    assert times.tolist() == [1.0, 3.0, 5.0]
    assert shares == pytest.approx([0.8, 0.8 * 2 / 3, 0.0])
    described = describe_durations(*durations)
    assert described.survival_mean_s == pytest.approx(1.0 + 2 * 0.8 + 2 * 0.8 * 2 / 3)
    assert described.survival_median_s == 5.0
    assert (described.complete.count, described.censored) == (3, 2)
    assert (described.complete.mean, described.complete.sd) == (3.0, 2.0)


def test_durations_that_are_all_censored_have_no_mean():
    durations = describe_durations(np.array([1.0, 2.0]), np.array([False, False]))
    assert (durations.censored, durations.survival_mean_s, durations.complete.mean) == (
        2,
        None,
        None,
    )
    # One seen and a longer one cut off: the curve stays at one half or above after the last end.
    times, complete = np.array([1.0, 2.0, 2.5]), np.array([True, False, False])
    open_ended = describe_durations(times, complete)
    assert open_ended.survival_median_s is None
    assert open_ended.survival_mean_s == pytest.approx(1.0 + 1.5 * 2.0 / 3.0)


@pytest.fixture(scope="module")
def measured(us101_scenes):
    return driving_statistics(us101_scenes)


def test_the_lane_changes(us101_scenes, measured):
    changes = measured.lane_changes
    rates = (
        changes.srlc,
        changes.per_vehicle_km,
        changes.per_vehicle_km_low,
        changes.per_vehicle_km_high,
    )
    assert rates == pytest.approx((0.34, 0.92, 0.70, 1.20), abs=0.005)
    assert changes.t_m_srlc_steps == pytest.approx(2220, abs=5)
    assert changes.count == changes.duration.complete.count + changes.duration.censored == 57
    assert changes.duration.complete.mean < changes.duration.survival_mean_s
    assert 2.5 < changes.duration.survival_mean_s < 4.5
    # The scene of each change is that of its last row in the old lane.
    rows = find_lane_changes(tracks_of_frame(us101_scenes)).sample
    counts = dict(us101_scenes[rows]["scene"].value_counts().iter_rows())
    per_scene = [counts.get(f"us101-{letter}", 0) for letter in "abcdefghijk"]
    assert per_scene == [16, 5, 3, 21, 2, 0, 3, 3, 0, 3, 1]


def test_the_spread_of_speeds_accelerations_and_headways(measured):
    assert (measured.speed_sd_in_frame, measured.speed_sd_in_lane) == pytest.approx(
        (2.8, 1.7), abs=0.05
    )
    smooth = [measured.acceleration_smoothed.quantile(level) for level in (0.05, 0.95)]
    assert smooth == pytest.approx([-1.2, 1.4], abs=0.05)
    headways = [measured.headway.quantile(level) for level in (0.05, 0.25, 0.5, 0.75, 0.95)]
    assert headways == pytest.approx([0.50, 0.93, 1.27, 1.93, 3.27], rel=0.03)
