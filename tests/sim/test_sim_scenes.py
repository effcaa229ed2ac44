"""Scenes set by hand start as they are written, vary as they are told, and hopeless ones are
refused by name.
"""

import math
import re

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.refusals import user_error
from reference.worlds import DOUBLE, episode_keys

from ganlane.settings.driving import Visibility
from ganlane.sim.idm import TABLE_V
from ganlane.sim.random import Stream
from ganlane.sim.scenes import LARGEST, FixedScene, SceneVehicle
from ganlane.sim.state import Road

ROAD = Road(2)
KEYS = episode_keys(range(1000), Stream.REPORT)


def scene(*rows, **options):
    return FixedScene(rows, ROAD, **options)  # type: ignore[arg-type]


def pair(gap_m, speed, leader, **options):
    """The ego behind one vehicle, bumper to bumper so far apart."""
    return scene(SceneVehicle(0.0, 0, speed), SceneVehicle(gap_m + 4.5, 0, leader), **options)


def test_the_ego_is_moved_to_zero_and_the_others_keep_their_distance():
    rows = ((100.0, 1, 20.0), (140.0, 0, 10.0), (60.0, 1, 15.0))
    v = scene(*(SceneVehicle(*row) for row in rows))(KEYS[:3], DOUBLE)
    assert v.x.tolist() == [[0.0, 40.0, -40.0]] * 3
    assert v.y[0].tolist() == [4.0, 0.0, 4.0]
    assert v.speed[0].tolist() == [20.0, 10.0, 15.0]
    assert v.target_lane[0].tolist() == [1, 0, 1]
    assert v.visibility[0].tolist() == [Visibility.BODY, Visibility.SIGNALLED, Visibility.SIGNALLED]


def test_jitter_follows_from_the_episode_alone_and_keeps_its_bounds():
    cars = (SceneVehicle(*row) for row in ((0.0, 0, 20.0), (90.0, 0, 0.0), (-60.0, 1, 0.2)))
    s = scene(*cars, jitter_m=2.0, jitter_mps=0.5)
    v = s(KEYS, DOUBLE)
    ego, ahead, behind = map(v.at, range(3))
    assert (ego.x == 0).all()
    assert 1.9 < (ahead.x - 90.0).abs().max() <= 2.0
    assert len(ahead.x.unique()) == 1000
    assert 0.45 < (ego.speed - 20.0).abs().max() <= 0.5
    assert (ahead.speed == 0).all()
    assert (behind.speed >= 0).all()
    alone = s(KEYS[700:701], DOUBLE)
    assert torch.equal(alone.x[0], v.x[700])
    assert torch.equal(alone.speed[0], v.speed[700])


@pytest.mark.parametrize(
    ("car", "what"),
    [
        (SceneVehicle(30.0, 2), "vehicle 1: lane=2: expected 0 to 1"),
        (SceneVehicle(30.0, y_m=5.5), "expected on the road, which runs from -2 to 6 m"),
        (SceneVehicle(30.0, 0, speed_mps=-1.0), "speed_mps=-1: expected at least 0"),
        (
            SceneVehicle(30.0, 0, desired_speed_mps=0.0),
            "desired_speed_mps=0: expected a number above 0",
        ),
        (SceneVehicle(math.nan, 0), "x_m=nan: expected a number from -1e+06 to 1e+06"),
        (SceneVehicle(30.0), "neither lane nor y_m"),
        (SceneVehicle(30.0, 0, y_m=4.0), "contradict each other"),
        (SceneVehicle(30.0, 0, target_lane=2), "target_lane=2: expected 0 to 1"),
        (SceneVehicle(10.0 * LARGEST, 0), "x_m=1e+07: expected a number from -1e+06 to 1e+06"),
        (
            SceneVehicle(40.0, 0, desired_speed_mps=1e-300),
            "desired_speed_mps=1e-300: expected a number above 0",
        ),
        (SceneVehicle(4.0, 0), "the ego and vehicle 1 overlap"),
    ],
)
def test_an_impossible_vehicle_is_refused_by_name(car, what):
    with user_error(re.escape(what)):
        scene(SceneVehicle(0.0, 0), car)


def test_jitter_that_could_make_an_overlap_is_refused():
    pair(3.0, 0.0, 0.0, jitter_m=2.9)  # the ego does not move
    with user_error(r"overlap \(with jitter_m=3\.1 at its worst\)"):
        pair(3.0, 0.0, 0.0, jitter_m=3.1)


def test_a_follower_that_would_need_more_than_the_strongest_braking_is_refused():
    """From 20 m/s to a standing car 9.9 m ahead: 20.2 m/s2; from 11 m: 18.2."""
    with user_error(r"ego at 20 m/s, 9\.9 m behind vehicle 1 at 0 m/s, would need 20\.2 m/s2"):
        pair(9.9, 20.0, 0.0).check(ROAD, TABLE_V)
    pair(11.0, 20.0, 0.0).check(ROAD, TABLE_V)


def test_a_lane_change_that_nobody_sees_in_time_is_refused():
    """Seen only once its centre is in the ego's lane; its body is there before.

    Signalled, it is seen at once.
    """
    signalled, hidden = (
        scene(
            SceneVehicle(0.0, 0, 25.0),
            SceneVehicle(30.0, 1, 8.0, 8.0, target_lane=0, visibility=seen),
        )
        for seen in (Visibility.SIGNALLED, Visibility.CENTRE)
    )
    signalled.check(ROAD, TABLE_V)
    with user_error("the ego and vehicle 1 crash after"):
        hidden.check(ROAD, TABLE_V)


def test_the_road_must_be_the_scenes():
    with user_error("2 lanes of 4 m, the traffic's has 3"):
        pair(50.0, 10.0, 10.0).check(Road(3), TABLE_V)


@settings(max_examples=8)
@given(gap=st.floats(0.2, 60.0), speed=st.floats(0.0, 40.0), leader=st.floats(0.0, 40.0))
def test_a_pair_is_refused_exactly_where_it_cannot_brake(gap, speed, leader):
    closing = max(speed - leader, 0.0)
    hopeless = closing * closing / (2.0 * gap) > -TABLE_V.min_acceleration
    if hopeless:
        with user_error("would need"):
            pair(gap, speed, leader).check(ROAD, TABLE_V)
    elif closing * (closing + 2.0) / (2.0 * gap) < -0.9 * TABLE_V.min_acceleration:
        pair(gap, speed, leader).check(ROAD, TABLE_V)
