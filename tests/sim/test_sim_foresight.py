"""Room for a lane change over the next seconds, worked out by hand; cars are 4.5 m long."""

import pytest
import torch
from reference.worlds import vehicles

from ganlane.settings.driving import Visibility
from ganlane.sim.foresight import has_room
from ganlane.sim.neighbours import perceive
from ganlane.sim.state import Road

CAR_M = 4.5


def room(ego, other, acceleration):
    """Whether the ego has it in lane 1, where leader and ego brake at 4 m/s2."""
    scene = perceive(vehicles({"x": 0.0} | ego, other), Road(3), slice(0, 1))
    lanes = torch.ones(1, 1, dtype=torch.float64)
    return bool(has_room(scene, lanes, torch.full_like(lanes, acceleration), 4.0))


@pytest.mark.parametrize(
    ("side", "speed", "acceleration", "other", "least_m"),
    [
        # A follower keeps its speed for 3 s. 5 m/s slower than it, and 1 m is left.
        (-1, 20.0, 0.0, 25.0, 16.0),
        # Its own lane makes the ego brake: 20 * 3 - 2 * 9 / 2 = 51 m instead of 60.
        (-1, 20.0, -2.0, 20.0, 10.0),
        # It will not rely on getting faster.
        (-1, 20.0, 1.5, 25.0, 16.0),
        # It stands after 1 s and 1 m, the follower comes 12 m.
        (-1, 2.0, -2.0, 4.0, 12.0),
        # A follower that falls back needs room at once.
        (-1, 20.0, 0.0, 10.0, 1.0),
        # A leader brakes until it stands. Half a second at 20 m/s, and 1 m is left.
        (1, 20.0, 0.0, 20.0, 11.0),
        # It stops within 100 / 8 m, the ego within 10 + 400 / 8 m.
        (1, 20.0, 0.0, 10.0, 48.5),
        (1, 20.0, 0.0, 0.0, 61.0),
        # One that drives away needs room at once.
        (1, 10.0, 0.0, 20.0, 1.0),
    ],
)
def test_so_much_room_is_needed_behind_and_ahead(side, speed, acceleration, other, least_m):
    for beyond_m, expected in ((0.01, True), (-0.01, False)):
        neighbour = {"x": side * (least_m + beyond_m + CAR_M), "lane": 1, "speed": other}
        assert room({"lane": 0, "speed": speed}, neighbour, acceleration=acceleration) == expected


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ({"lane": 0}, True),
        ({"lane": 1}, False),
        ({"lane": 2}, True),
        ({"lane": 2, "target_lane": 1, "visibility": Visibility.SIGNALLED}, False),
        # It says nothing, but in a second its centre will be in the middle lane.
        ({"lane": 2, "y": 7.0, "heading": -0.1, "visibility": Visibility.CENTRE}, False),
        ({"lane": 2, "y": 7.0, "heading": 0.1, "visibility": Visibility.CENTRE}, True),
        ({"lane": 1, "valid": False}, True),
    ],
)
def test_who_is_on_the_way_into_the_lane_counts_as_in_it(other, expected):
    """As fast as the ego, on the far side of the lane between them, five metres behind it."""
    beside = {"x": -(5.0 + CAR_M), "speed": 20.0} | other
    assert room({"lane": 0, "speed": 20.0}, beside, acceleration=-2.0) == expected
