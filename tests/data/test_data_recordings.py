"""The US-101 recordings: the figures published with them come out. Skipped where the recordings are not there."""

import numpy as np
import polars as pl
import pytest

from ganlane.data import (
    default_scenes,
    driving_statistics,
    find_lane_changes,
    read_scenes,
    scene_lane_widths,
    tracks_of_frame,
)
from ganlane.errors import UserError


@pytest.fixture(scope="module")
def scenes():
    try:
        path = default_scenes()
    except UserError as missing:
        pytest.skip(str(missing))
    return read_scenes(path)


@pytest.fixture(scope="module")
def measured(scenes):
    return driving_statistics(scenes)


def test_the_amount_of_driving(measured):
    exposure = measured.exposure
    assert (exposure.scenes, exposure.tracks, exposure.cars, exposure.samples) == (11, 645, 539, 47_382)
    assert exposure.vehicle_km == pytest.approx(61.7, abs=0.05)
    assert exposure.road_m == pytest.approx(309, abs=0.5)
    assert measured.speed.mean == pytest.approx(13.2, abs=0.05)
    assert measured.speed.quantile(0.5) == pytest.approx(13.7, abs=0.05)


def test_the_lane_changes(measured):
    changes = measured.lane_changes
    assert changes.count == 57
    assert changes.srlc == pytest.approx(0.34, abs=0.005)
    rate = (changes.per_vehicle_km, changes.per_vehicle_km_low, changes.per_vehicle_km_high)
    assert rate == pytest.approx((0.92, 0.70, 1.20), abs=0.005)
    assert changes.t_m_srlc_steps == pytest.approx(2220, abs=5)
    assert changes.duration.complete.count + changes.duration.censored == 57
    assert changes.duration.complete.mean < changes.duration.survival_mean_s
    assert 2.5 < changes.duration.survival_mean_s < 4.5


def test_the_lane_changes_of_each_scene(scenes):
    rows = find_lane_changes(tracks_of_frame(scenes)).sample
    counts = dict(scenes[rows]["scene"].value_counts().iter_rows())
    assert [counts.get(f"us101-{letter}", 0) for letter in "abcdefghijk"] == [16, 5, 3, 21, 2, 0, 3, 3, 0, 3, 1]


def test_the_lane_widths(scenes):
    published = [3.50, 3.54, 3.44, 3.42, 3.58, 3.56, 3.52, 3.33, 3.53, 3.35, 3.39]
    widths = scene_lane_widths(scenes)
    assert [widths[f"us101-{letter}"] for letter in "abcdefghijk"] == pytest.approx(published, abs=0.035)
    width = scenes["scene"].replace_strict(widths).to_numpy()
    assert np.mean(np.rint(scenes["y"].to_numpy() / width) == scenes["lane"].to_numpy()) > 0.999
    assert scenes.filter(pl.col("scene") == "us101-d")["lane"].max() == 6


def test_the_spread_of_speeds_accelerations_and_headways(measured):
    assert measured.speed_sd_in_frame == pytest.approx(2.8, abs=0.05)
    assert measured.speed_sd_in_lane == pytest.approx(1.7, abs=0.05)
    smooth = [measured.acceleration_smoothed.quantile(level) for level in (0.05, 0.95)]
    assert smooth == pytest.approx([-1.2, 1.4], abs=0.05)
    headways = [measured.headway.quantile(level) for level in (0.05, 0.25, 0.5, 0.75, 0.95)]
    assert headways == pytest.approx([0.50, 0.93, 1.27, 1.93, 3.27], rel=0.03)
