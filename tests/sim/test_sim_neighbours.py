"""Whom a driver finds ahead and behind.

By hand, against a loop, and by sorting bit for bit as by comparing pairs.
"""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.worlds import DOUBLE, drawing, vehicles, vehicles_at

from ganlane.settings.driving import Visibility
from ganlane.sim import neighbours
from ganlane.sim.neighbours import FREE_GAP_M, follower, leader, perceive
from ganlane.sim.state import Road, Vehicles

ROAD = Road(lanes=3)
ROWS = 20
SORT = 0
PAIRS = 10**12


def lane(number: float, scene) -> torch.Tensor:
    return torch.full_like(scene.x, number)


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
    ahead = leader(seen, lane(1.0, scene))
    behind = follower(seen, lane(1.0, scene))
    assert (ahead.gap[0, 0], ahead.speed[0, 0]) == (30.0 - 4.5, 11.0)
    assert (behind.gap[0, 0], behind.speed[0, 0], behind.desired_speed[0, 0]) == (
        25.0 - 4.5,
        13.0,
        33.0,
    )
    right = leader(seen, lane(0.0, scene))
    assert (right.gap[0, 0], right.speed[0, 0]) == (20.0 - 4.5, 12.0)
    assert not follower(seen, lane(0.0, scene)).exists[0, 0]


def test_followers_keep_off_the_rear_of_a_lorry_and_not_off_its_middle():
    """Centres 30 m apart, so 21.75 m are free.

    The lorry itself is 30 - 8.25 m behind the car ahead of it.
    """
    scene = perceive(vehicles({"x": 0.0}, {"x": 30.0, "length": 12.0}, {"x": 60.0}), ROAD)
    assert leader(scene, scene.body.low).gap[0, :2].tolist() == pytest.approx([21.75, 21.75])


# Any scene


def scenes(cars: int, lanes: int, seed: int, grid_m: float, dtype: torch.dtype) -> Vehicles:
    """Cars, lorries and empty places, every third in a lane change.

    On a coarse grid many stand level.
    """
    between = drawing((ROWS, cars), seed, dtype)
    here = between(0, lanes).long()
    target = (here + between(-1.5, 1.5).round().long()).clamp(0, lanes - 1)
    return vehicles_at(
        (between(-150, 150) / grid_m).round() * grid_m,
        target,
        y=4.0 * (here + (target - here) * between(0, 1)),
        heading=between(-0.1, 0.1),
        speed=between(0, 4).round() * 7.3,
        length=torch.where(between(0, 1) < 0.3, 12.0, 4.5).to(dtype),
        desired_speed=between(15, 35),
        visibility=between(-0.5, len(Visibility) - 0.5).round().long(),
        valid=between(0, 1) < 0.9,
    )


@settings(max_examples=60, deadline=None)
@given(
    cars=st.integers(1, 30),
    lanes=st.integers(1, 6),
    seed=st.integers(0, 2**31),
    grid_m=st.sampled_from([0.25, 5.0, 1e-3]),
    own_roads=st.booleans(),
)
def test_both_ways_find_the_same_neighbours(cars, lanes, seed, grid_m, own_roads):
    vehicles = scenes(cars, lanes, seed, grid_m, torch.float32)
    road = (
        Road(torch.full((ROWS, 1), lanes), torch.full((ROWS, 1), 4.0)) if own_roads else Road(lanes)
    )
    asked = vehicles.target_lane[..., None] + torch.tensor([0.0, 1.0, -1.0])
    by_way = {}
    for way in (SORT, PAIRS):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(neighbours, "SORTS_FROM", way)
            scene = perceive(vehicles, road)
            assert (scene.queue is not None) == (way == SORT)
            by_way[way] = leader(scene, asked), follower(scene, asked)
    for ours, theirs in zip(*by_way.values()):
        exists = ours.gap < FREE_GAP_M
        assert torch.equal(ours.gap, theirs.gap)
        assert torch.equal(ours.speed[exists], theirs.speed[exists])
    (_, behind), (_, others) = by_way.values()
    assert torch.equal(behind.desired_speed[behind.exists], others.desired_speed[others.exists])


def test_the_leader_has_the_nearest_rear_and_is_the_slowest_of_those():
    """Against a loop over the vehicles; gaps are of today's formula, up to rounding."""
    vehicles = scenes(12, 3, seed=4, grid_m=2.5, dtype=DOUBLE)
    scene = perceive(vehicles, ROAD)
    number = vehicles.target_lane.double()
    nearest, (low, high) = leader(scene, number), scene.presence
    for row in range(ROWS):
        for i in range(12):
            ahead = [
                (scene.pairs.ahead[row, i, j].item(), vehicles.speed[row, j].item())
                for j in range(12)
                if scene.pairs.order[row, i, j] > 0
                and low[row, j] <= number[row, i] <= high[row, j]
            ]
            expected = min(ahead, default=(FREE_GAP_M, vehicles.speed[row, i].item()))
            assert (nearest.gap[row, i].item(), nearest.speed[row, i].item()) == expected
