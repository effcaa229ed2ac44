"""Recorded scenes driven by traffic models: who is there, when, and what stays as recorded."""

import numpy as np
import polars as pl
import pytest

from ganlane.data import SyntheticTraffic, scene_lane_widths, synthetic_scenes
from ganlane.evaluation.realism.distances import pooled_distance
from ganlane.evaluation.realism.drivers import ConstantVelocity, RandomDriving
from ganlane.evaluation.realism.driving import drive, measure_recordings
from ganlane.evaluation.realism.recordings import Recording, recorded_frame, recordings_of
from ganlane.evaluation.realism.simulation import StartOptions, drive_recordings
from ganlane.sim.vehicles import Vehicles
from ganlane.traffic import IdmMobilTraffic, TrafficModule
from ganlane.traffic.presets import gan_calibrated_traffic, gan_traffic


def steady(**changed):
    """Three cars for 10 s at speeds of their own, the last of which appears after 4 s and leaves after 8."""
    time = np.arange(100)[:, None] * 0.1
    speed = np.array([10.0, 12.0, 15.0])
    x = np.array([0.0, 40.0, 20.0]) + speed * time
    y = np.broadcast_to(np.array([0.0, 0.0, 3.5]), x.shape).copy()
    present = np.ones(x.shape, bool)
    present[:40, 2] = present[80:, 2] = False
    size = np.ones(3)
    fields = {"x": x, "y": y, "speed": np.broadcast_to(speed, x.shape).copy(), "present": present}
    return Recording(
        "steady", "steady", 2, 3.5, **{**fields, **changed}, length=4 * size, width=2 * size, driven=size > 0
    )


def test_constant_velocity_repeats_a_recording_of_constant_velocity():
    there = drive_recordings(ConstantVelocity, [steady()], StartOptions())
    recorded = recorded_frame([steady()])
    assert there.height == recorded.height
    joined = there.join(recorded, on=["vehicle", "frame"], suffix="_recorded")
    assert joined.height == recorded.height
    assert (joined["x"] - joined["x_recorded"]).abs().max() < 1e-3
    assert (joined["y"] - joined["y_recorded"]).abs().max() < 1e-5


def test_its_distance_is_then_0_in_every_quantity():
    recordings = [steady()]
    recorded = measure_recordings(recordings)
    driven = drive(ConstantVelocity, recordings, StartOptions())
    for name in ("speed", "gap", "time_headway"):
        # Speeds of 10 m/s lie on an edge of the bins, which rounding may cross; compare at the middle.
        assert driven.measured.quantile(name, 0.5) == pytest.approx(recorded.quantile(name, 0.5), abs=1e-2)
    assert pooled_distance(driven.counts["gap"], recorded.counts(["steady"], "gap")) < 0.15


def test_a_vehicle_enters_when_it_was_recorded_first_and_leaves_when_last():
    there = drive_recordings(ConstantVelocity, [steady()], StartOptions())
    frames = there.group_by("vehicle").agg(pl.col("frame").min().alias("first"), pl.col("frame").max().alias("last"))
    assert frames.sort("vehicle").rows() == [(0, 0, 99), (1, 0, 99), (2, 40, 79)]


def test_a_vehicle_waits_while_another_stands_in_its_place():
    blocked = steady()
    # The third appears in the first lane, where a car driven at constant velocity is just then.
    x, y = blocked.x.copy(), blocked.y.copy()
    y[:, 2] = 0.0
    x[:, 2] = x[:, 0] + 3.0 * (np.arange(100) * 0.1 - 4.0)
    there = drive_recordings(ConstantVelocity, [steady(x=x, y=y)], StartOptions())
    first = there.filter(pl.col("vehicle") == 2)["frame"].min()
    # 4 m of length and 2 m of room at 3 m/s of difference: 2 s later.
    assert first == pytest.approx(60, abs=1)


def test_nobody_drives_beyond_the_end_of_the_recorded_road():
    class Fast(ConstantVelocity):
        def move(self, vehicles, memory, key, step):
            return super().move(vehicles.with_(speed=vehicles.speed + 1.0), memory, key, step)

    recording = steady()
    there = drive_recordings(Fast, [recording], StartOptions())
    assert there["x"].max() <= recording.end_m + 0.02
    assert there.height < recorded_frame([recording]).height


def test_replayed_vehicles_drive_as_recorded_whatever_the_model_does():
    recording = Recording(**{**vars(steady()), "driven": np.array([True, False, True])})
    there = drive_recordings(RandomDriving, [recording], StartOptions())
    replayed = there.filter(pl.col("vehicle") == 1)
    assert replayed["x"].to_numpy() == pytest.approx(recording.x[:, 1], abs=1e-3)
    assert not replayed["driven"].any()


def test_index_0_is_nobody_and_models_see_desired_speeds_above_the_speed_at_entry():
    seen = []

    class Watcher(TrafficModule):
        def move(self, vehicles: Vehicles, memory, key, step):
            seen.append(vehicles)
            return vehicles, memory

    drive_recordings(Watcher, [steady()], StartOptions(desired_above_mps=3.0, repeats=50))
    assert not any(bool(vehicles.valid[:, 0].any()) for vehicles in seen)
    excess = (seen[0].desired_speed - seen[0].speed)[:, 1:3]
    assert excess.min() >= 0.0
    assert excess.max() <= 6.0
    assert excess.mean() == pytest.approx(3.0, abs=0.5)


def test_repeats_differ_and_the_same_seed_repeats_them():
    runs = [drive_recordings(RandomDriving, [steady()], StartOptions(repeats=2, seed=seed)) for seed in (0, 0, 1)]
    assert runs[0].equals(runs[1])
    assert not runs[0].equals(runs[2])
    one, other = (runs[0].filter(pl.col("scene") == f"steady#{number}")["x"] for number in (0, 1))
    assert not one.equals(other)


@pytest.mark.parametrize("make", [IdmMobilTraffic, gan_traffic, gan_calibrated_traffic, RandomDriving])
def test_every_traffic_stays_finite_from_recorded_starts(make):
    frame = synthetic_scenes(SyntheticTraffic(scenes=1, vehicles=8, seconds=5.0))
    there = drive_recordings(make, recordings_of(frame, scene_lane_widths(frame)), StartOptions())
    for name in ("x", "y"):
        assert there[name].is_finite().all()
    assert there["lane"].is_between(0, 2).all()


def test_the_floor_drives_neither_backwards_nor_smoothly():
    there = drive(RandomDriving, [steady()], StartOptions(repeats=20)).measured
    assert there.quantile("acceleration", 0.95) > 1.0
    assert there.quantile("speed", 0.0) >= 0.0
