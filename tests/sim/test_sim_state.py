"""Which lanes a vehicle is in, and the road: cases worked by hand.

And bodies that stand in three lanes at once.
"""

import math

import pytest
import torch
from reference.marks import slow
from reference.worlds import drawing, moves, vehicles, vehicles_at

from ganlane.settings.driving import Visibility
from ganlane.sim import idm
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.idm import idm_acceleration
from ganlane.sim.state import (
    ARRIVED_M,
    Road,
    body_lanes,
    presence,
    with_target,
)
from ganlane.traffic.idm_mobil import IdmTraffic

ROAD = Road(lanes=3)


def seen_in(**car):
    """Lowest and highest lane in which the others see a car, by its body unless told otherwise."""
    scene = vehicles({"x": 0.0, "visibility": Visibility.BODY, **car})
    body = body_lanes(scene, ROAD)
    low, high = presence(scene, ROAD, body, with_target(body, scene))
    return low.item(), high.item()


@pytest.mark.parametrize(
    ("y", "lanes"),
    # A lane's edge is 2 m from its centre; half a body is 1.25 m; 0.1 m over the edge does not
    # count.
    [
        (0.0, (0, 0)),
        (0.84, (0, 0)),
        (0.86, (0, 1)),
        (2.0, (0, 1)),
        (3.14, (0, 1)),
        (3.16, (1, 1)),
        (4.0, (1, 1)),
    ],
)
def test_a_body_is_in_every_lane_that_it_enters_by_more_than_a_tenth_of_a_metre(y, lanes):
    assert seen_in(y=y, target_lane=1) == lanes


def test_a_turned_body_takes_more_room():
    # half extent at 0.2 rad: (2.5 cos 0.2 + 4.5 sin 0.2) / 2 = 1.672; over the edge by 0.1 from y =
    # 0.428 on
    assert 0.5 * (2.5 * math.cos(0.2) + 4.5 * math.sin(0.2)) == pytest.approx(1.672, abs=1e-3)
    for heading in (0.2, -0.2):
        assert seen_in(y=0.42, heading=heading) == (0, 0)
        assert seen_in(y=0.44, heading=heading) == (0, 1)


def test_a_signalled_car_is_in_its_target_lane_from_the_command_on():
    for y, target, lanes in ((0.0, 1, (0, 1)), (3.9, 1, (1, 1)), (4.0, 0, (0, 1))):
        assert seen_in(y=y, target_lane=target, visibility=Visibility.SIGNALLED) == lanes


# The road


def test_lane_zero_is_the_rightmost_and_lanes_end_at_the_edges():
    y = torch.tensor([-9.0, -1.9, 1.9, 2.1, 8.0, 99.0])
    assert ROAD.lane_of(y).tolist() == [0, 0, 0, 1, 2, 2]
    assert ROAD.centre_of(torch.tensor([0, 1, 2])).tolist() == [0.0, 4.0, 8.0]
    assert (ROAD.right_edge_m(), ROAD.left_edge_m()) == (-2.0, 10.0)


# In narrow lanes a body that is turned stands in three lanes at once, and its driver looks into all
# of them: a second change right after a first one, the rear still in the lane that it comes from,
# and a slow car in the lane between.

CHANGES = 0
SLOWER = 1
DESIRED_MPS = 25.0


def first_changes(lane_width_m, length_m):
    """One changes from lane 0 to lane 1, where a slower one is 2 to 32 m ahead.

    IDM asks for less than 4 m/s2.
    """
    between = drawing((20_000,), 0)
    speed = between(0.5, 12.0)
    slower = (speed - between(0.0, 6.0)).clamp_min(0.05)
    gap = 2.0 + between(0.0, 30.0)
    calm = idm_acceleration(speed, DESIRED_MPS, gap, slower) > -4.0
    lane = torch.tensor([0, 1]).expand(len(gap), 2)
    zero = torch.zeros_like(gap)
    scene = vehicles_at(
        torch.stack((zero, gap + length_m), dim=1),
        torch.ones_like(lane),
        y=lane * lane_width_m,
        speed=torch.stack((speed, slower), dim=1),
        length=zero[:, None].expand(-1, 2) + length_m,
        desired_speed=torch.stack((zero + DESIRED_MPS, slower + 0.01), dim=1),
    )
    return scene.part(calm)


def drive(lane_width_m, length_m):
    """Over 15 s.

    Scenes, those in which the two overlap, those in which the first stands in three lanes at once.
    """

    def on_to_lane_2(before, cars):
        """In the moment that the change to lane 1 counts as complete."""
        arrived = (cars.y - lane_width_m).abs() < ARRIVED_M
        goes_on = arrived & (cars.target_lane == 1) & (torch.arange(2) == CHANGES)
        return cars.with_(target_lane=torch.where(goes_on, 2, cars.target_lane))

    road = Road(lanes=3, lane_width_m=lane_width_m)
    start = first_changes(lane_width_m, length_m)
    hit = three = torch.zeros(len(start.x), dtype=torch.bool)
    for cars in moves(IdmTraffic(road), start, 150, on_to_lane_2):
        hit = hit | pair_overlaps(cars)[:, CHANGES, SLOWER]
        attends = with_target(body_lanes(cars, road), cars)
        three = three | (attends.high - attends.low >= 2)[:, CHANGES]
    return len(hit), int(hit.sum()), int(three.sum())


@pytest.mark.parametrize(
    ("lane_width_m", "length_m", "before"),
    [
        (2.55, 4.5, 229),
        slow(2.7, 4.5, 157),
        slow(2.9, 4.5, 66),
        slow(3.0, 4.5, 7),
        slow(3.5, 12.0, None),
    ],
)
def test_who_changes_two_lanes_in_a_row_does_not_touch_the_slower_car_in_between(
    lane_width_m, length_m, before, monkeypatch
):
    scenes, overlaps, three = drive(lane_width_m, length_m)
    assert scenes > 15_000
    assert three > 1000
    assert overlaps == 0
    if before is not None:
        # With the lowest and the highest lane alone it would: the figures of docs/simulator.md.
        monkeypatch.setattr(
            idm, "spanned", lambda lanes: torch.stack((lanes.low, lanes.low, lanes.high), dim=-1)
        )
        scenes, overlaps, _ = drive(lane_width_m, length_m)
        assert scenes == 15_937
        assert overlaps == pytest.approx(before, abs=3)
