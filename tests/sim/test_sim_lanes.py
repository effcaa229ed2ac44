"""Which lanes a vehicle is in, and whom a driver finds ahead and behind: cases worked by hand."""

from __future__ import annotations

import math

import pytest
import torch
from reference.worlds import DOUBLE, vehicles

from ganlane.parameters.driving import Visibility
from ganlane.sim.neighbours import FREE_GAP_M, follower, leader, perceive
from ganlane.sim.state import Road, body_lanes, lane_change_done, presence, with_target

ROAD = Road(lanes=3)


def seen_in(**car) -> tuple[float, float]:
    """Lowest and highest lane in which the others see a car."""
    scene = vehicles({"x": 0.0, **car})
    body = body_lanes(scene, ROAD)
    low, high = presence(scene, ROAD, body, with_target(body, scene))
    return low.item(), high.item()


def lane(number: float, scene) -> torch.Tensor:
    return torch.full_like(scene.x, number)


@pytest.mark.parametrize(
    ("y", "lanes"),
    # A lane's edge is 2 m from its centre; half a body is 1.25 m; 0.1 m over the edge does not count.
    [(0.0, (0, 0)), (0.84, (0, 0)), (0.86, (0, 1)), (2.0, (0, 1)), (3.14, (0, 1)), (3.16, (1, 1)), (4.0, (1, 1))],
)
def test_a_body_is_in_every_lane_that_it_enters_by_more_than_a_tenth_of_a_metre(y, lanes):
    assert seen_in(y=y, target_lane=1, visibility=Visibility.BODY) == lanes


def test_a_turned_body_takes_more_room():
    # half extent at 0.2 rad: (2.5 cos 0.2 + 4.5 sin 0.2) / 2 = 1.672; over the edge by 0.1 from y = 0.428 on
    assert 0.5 * (2.5 * math.cos(0.2) + 4.5 * math.sin(0.2)) == pytest.approx(1.672, abs=1e-3)
    for heading in (0.2, -0.2):
        assert seen_in(y=0.42, heading=heading, target_lane=0, visibility=Visibility.BODY) == (0, 0)
        assert seen_in(y=0.44, heading=heading, target_lane=0, visibility=Visibility.BODY) == (0, 1)


@pytest.mark.parametrize(
    ("y", "lanes"), [(0.0, (0, 0)), (1.9, (0, 0)), (2.1, (1, 1)), (-3.0, (0, 0)), (30.0, (2, 2))]
)
def test_seen_by_its_centre_a_car_is_in_one_lane_of_the_road(y, lanes):
    assert seen_in(y=y, target_lane=1, visibility=Visibility.CENTRE) == lanes


def test_a_signalled_car_is_in_its_target_lane_from_the_command_on():
    assert seen_in(y=0.0, target_lane=1, visibility=Visibility.SIGNALLED) == (0, 1)
    assert seen_in(y=0.0, target_lane=1, visibility=Visibility.BODY) == (0, 0)
    assert seen_in(y=3.9, target_lane=1, visibility=Visibility.SIGNALLED) == (1, 1)
    assert seen_in(y=4.0, target_lane=0, visibility=Visibility.SIGNALLED) == (0, 1)


def test_an_invalid_car_is_nowhere():
    low, high = seen_in(lane=1, valid=False)
    assert low > high


def test_a_change_is_complete_within_0_3_m_of_the_centre():
    scene = vehicles(*({"x": 0.0, "y": y, "target_lane": 1} for y in (3.69, 3.71, 4.29, 4.31)))
    assert lane_change_done(scene, ROAD).tolist() == [[False, True, True, False]]


# Leaders and followers


def test_leader_and_follower_are_the_nearest_in_the_lane_asked_for():
    scene = vehicles(
        {"x": 0.0, "lane": 1},
        {"x": 30.0, "lane": 1, "speed": 11.0},
        {"x": 60.0, "lane": 1},
        {"x": 20.0, "lane": 0, "speed": 12.0},
        {"x": -25.0, "lane": 1, "speed": 13.0, "desired_speed": 33.0},
        {"x": -70.0, "lane": 1},
    )
    seen = perceive(scene, ROAD)
    ahead, behind = leader(seen, lane(1.0, scene)), follower(seen, lane(1.0, scene))
    assert (ahead.gap[0, 0], ahead.speed[0, 0]) == (30.0 - 4.5, 11.0)
    assert (behind.gap[0, 0], behind.speed[0, 0], behind.desired_speed[0, 0]) == (25.0 - 4.5, 13.0, 33.0)
    right = leader(seen, lane(0.0, scene))
    assert (right.gap[0, 0], right.speed[0, 0]) == (20.0 - 4.5, 12.0)
    assert not follower(seen, lane(0.0, scene)).exists[0, 0]


def test_an_empty_lane_is_free_for_ten_kilometres_and_moves_with_the_driver():
    scene = vehicles({"x": 0.0, "lane": 1, "speed": 17.0}, {"x": 5.0, "lane": 0})
    ahead = leader(perceive(scene, ROAD), lane(2.0, scene))
    assert (ahead.gap[0, 0], ahead.speed[0, 0]) == (FREE_GAP_M, 17.0)


def test_an_invalid_car_is_nobodys_leader():
    scene = vehicles({"x": 0.0, "lane": 1}, {"x": 10.0, "lane": 1, "valid": False}, {"x": 50.0, "lane": 1})
    assert leader(perceive(scene, ROAD), lane(1.0, scene)).gap[0, 0] == 45.5


def test_side_by_side_in_two_lanes_the_one_of_lower_index_is_ahead():
    """So that of two who would enter one gap exactly one gives way."""
    scene = vehicles({"x": 0.0, "lane": 0}, {"x": 0.0, "lane": 0})
    seen = perceive(scene, ROAD)
    ahead, behind = leader(seen, lane(0.0, scene)), follower(seen, lane(0.0, scene))
    assert ahead.gap[0].tolist() == [FREE_GAP_M, -4.5]
    assert behind.gap[0].tolist() == [-4.5, FREE_GAP_M]


def test_the_view_of_the_ego_alone_is_the_first_row_of_everybodys():
    generator = torch.Generator().manual_seed(3)
    scene = vehicles(*({"x": 10.0 * k, "lane": k % 3} for k in (3, 0, 1, 2, 4, 5)))
    scene = scene.with_(y=scene.y + torch.randn(scene.y.shape, generator=generator, dtype=DOUBLE))
    all_of_them, ego = perceive(scene, ROAD), perceive(scene, ROAD, slice(0, 1))
    for number in range(3):
        whole, alone = leader(all_of_them, lane(number, scene)), leader(ego, torch.full((1, 1), float(number)))
        assert torch.equal(whole.gap[:, :1], alone.gap)
        assert torch.equal(whole.speed[:, :1], alone.speed)


# The road


def test_lane_zero_is_the_rightmost_and_lanes_end_at_the_edges():
    y = torch.tensor([-9.0, -1.9, 1.9, 2.1, 8.0, 99.0])
    assert ROAD.lane_of(y).tolist() == [0, 0, 0, 1, 2, 2]
    assert ROAD.centre_of(torch.tensor([0, 1, 2])).tolist() == [0.0, 4.0, 8.0]
    assert (ROAD.right_edge_m(), ROAD.left_edge_m()) == (-2.0, 10.0)


def test_every_row_may_have_a_road_of_its_own():
    road = Road(lanes=torch.tensor([[1], [4]]), lane_width_m=torch.tensor([[3.0], [4.0]]))
    assert road.lane_of(torch.tensor([[6.1], [6.1]])).tolist() == [[0.0], [2.0]]


def test_on_a_ring_distances_take_the_nearer_way_round():
    ring = Road(lanes=1, ring_m=100.0)
    start, end = torch.tensor([95.0, 5.0, 0.0, 0.0]), torch.tensor([5.0, 95.0, 210.0, 40.0])
    assert ring.distance_ahead(start, end).tolist() == [10.0, -10.0, 10.0, 40.0]
