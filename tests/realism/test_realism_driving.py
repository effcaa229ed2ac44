"""Recorded scenes driven by traffic models: who is there, when, and what stays as recorded."""

import math

import numpy as np
import polars as pl
import pytest
import torch
from reference.recordings import made_by_hand
from reference.small_networks import anchored_drivers, silenced, small_generator
from reference.worlds import vehicles as vehicles_of
from tensordict import TensorDict

from ganlane.generator.closed_loop import balanced_headway
from ganlane.realism.driving import (
    ConstantVelocity,
    RandomDriving,
    StartOptions,
    drive_recordings,
    with_recorded_headways,
)
from ganlane.settings.generator import EXTRA_INPUTS
from ganlane.sim.state import Road
from ganlane.traffic import TrafficModule
from ganlane.traffic.social_gan import AnchoredGanTraffic


def steady(**changed):
    """Three cars for 10 s at speeds of their own, the last of which appears after 4 s and leaves
    after 8.
    """
    time = np.arange(100)[:, None] * 0.1
    # The third car is in the lane beside the others.
    speed = np.array([10.0, 12.0, 15.0])
    present = np.ones((100, 3), bool)
    present[:40, 2] = present[80:, 2] = False
    x = np.array([0.0, 40.0, 20.0]) + speed * time
    fields = {"x": x, "y": np.array([0.0, 0.0, 3.5]), "speed": speed, "present": present, **changed}
    return made_by_hand(**fields, lanes=2, name="steady")


def driven_frame(make, recording, **options):
    """The trajectories that a traffic drives from a recording."""
    driven = drive_recordings(make, [recording], StartOptions(**options))
    return pl.concat([one.frame() for one in driven])


def test_constant_velocity_repeats_a_recording_of_it_from_a_vehicles_first_frame_to_its_last():
    there = driven_frame(ConstantVelocity, steady())
    recorded = steady().frame()
    joined = there.join(recorded, on=["vehicle", "frame"], suffix="_recorded")
    assert joined.height == there.height == recorded.height
    assert (joined["x"] - joined["x_recorded"]).abs().max() < 1e-3
    assert (joined["y"] - joined["y_recorded"]).abs().max() < 1e-5
    frames = there.group_by("vehicle").agg(
        pl.col("frame").min().alias("first"), pl.col("frame").max().alias("last")
    )
    assert frames.sort("vehicle").rows() == [(0, 0, 99), (1, 0, 99), (2, 40, 79)]


def test_a_vehicle_waits_while_another_stands_in_its_place():
    x, y = steady().x, steady().y
    # The third appears in the first lane, where a car driven at constant velocity is just then.
    y[:, 2] = 0.0
    x[:, 2] = x[:, 0] + 3.0 * (np.arange(100) * 0.1 - 4.0)
    there = driven_frame(ConstantVelocity, steady(x=x, y=y))
    first = there.filter(pl.col("vehicle") == 2)["frame"].min()
    # 4 m of length and 2 m of room at 3 m/s of difference: 2 s later.
    assert first == pytest.approx(60, abs=1)


def test_nobody_drives_beyond_the_end_of_the_recorded_road():
    class Fast(ConstantVelocity):
        def move(self, vehicles, memory, key, step):
            return super().move(vehicles.with_(speed=vehicles.speed + 1.0), memory, key, step)

    recording = steady()
    there = driven_frame(Fast, recording)
    assert there["x"].max() <= recording.end_m + 0.02
    assert there.height < recording.frame().height


def test_replayed_vehicles_drive_as_recorded_whatever_the_model_does():
    recording = steady(driven=np.array([True, False, True]))
    there = driven_frame(RandomDriving, recording)
    replayed = there.filter(pl.col("vehicle") == 1)
    assert replayed["x"].to_numpy() == pytest.approx(recording.x[:, 1], abs=1e-3)
    assert not replayed["driven"].any()


def test_index_0_is_nobody_and_models_see_desired_speeds_above_the_speed_at_entry():
    seen = []

    # Keeps what a traffic is given at each step.
    class Watcher(TrafficModule):
        def move(self, vehicles, memory, key, step):
            seen.append(vehicles)
            return vehicles, memory

    drive_recordings(Watcher, [steady()], StartOptions(desired_above_mps=3.0, repeats=50))
    assert not any(bool(vehicles.valid[:, 0].any()) for vehicles in seen)
    excess = (seen[0].desired_speed - seen[0].speed)[:, 1:3]
    assert 0.0 <= excess.min() <= excess.max() <= 6.0
    assert excess.mean() == pytest.approx(3.0, abs=0.5)


ROAD = Road()
DRAWN = 9.0


def queue(x):
    """One row of vehicles of 4 m at 10 m/s in the first lane; index 0 is nobody."""
    same = {"speed": 10.0, "desired_speed": 20.0, "length": 4.0}
    cars = [{"x": at, **same} for at in x]
    return vehicles_of({"x": -500.0, "valid": False}, *cars, dtype=torch.float32)


def headways(vehicles):
    return balanced_headway(vehicles, ROAD, torch.full_like(vehicles.x, DRAWN))[0, 1:].tolist()


def test_a_follower_shows_its_headway_unless_it_is_far_behind_and_none_under_a_tenth_of_a_second():
    behind, ahead = headways(queue([0.0, 24.0]))
    # At 20 m and 10 m/s: (20 m sqrt(1 - (10 / 20)^4) - 2 m) / (10 m/s)
    assert behind == pytest.approx((20.0 * math.sqrt(15.0 / 16.0) - 2.0) / 10.0, abs=1e-4)
    assert ahead == headways(queue([0.0, 64.0]))[0] == DRAWN
    assert headways(queue([0.0, 5.0]))[0] == pytest.approx(0.1)


def test_only_those_who_enter_are_credited_and_other_memories_stay_as_they_are():
    vehicles = queue([0.0, 24.0, 48.0])
    drawn = torch.full_like(vehicles.x, DRAWN)
    memory = TensorDict(
        {"driver": TensorDict({"headway": drawn, "noise": drawn}, [1]), "wish": drawn}, [1]
    )
    # Only the first of the three enters.
    who = torch.tensor([[False, True, False, False]])
    after = with_recorded_headways(memory, vehicles, ROAD, who)
    assert after["driver", "headway"][0, 1] < 3.0
    assert (after["driver", "headway"][0, 2:] == DRAWN).all()
    assert torch.equal(after["driver", "noise"], drawn)
    assert torch.equal(after["wish"], drawn)
    assert (memory["driver", "headway"] == DRAWN).all()


def test_a_recorded_platoon_keeps_its_gaps_behind_a_leader_at_constant_speed():
    time = np.arange(60)[:, None] * 0.1
    # The foremost is replayed.
    x = np.array([0.0, 12.0, 40.0, 55.0]) + 10.0 * time
    scene = made_by_hand(x, speed=10.0, lanes=1, driven=np.array([True, True, True, False]))
    network = silenced(small_generator(EXTRA_INPUTS))
    there = driven_frame(
        # Without a residual there are only IDM and each driver's headway.
        lambda road: AnchoredGanTraffic(network, anchored_drivers(network), road),
        scene,
        desired_above_mps=5.0,
    )
    ends = there.filter(there["frame"] == 59).sort("vehicle")["x"].to_numpy()
    assert np.abs(ends - x[59]).max() < 0.01
