"""Whom a driver finds ahead and behind.

Against the scalar simulator, and by sorting bit for bit as by comparing pairs.
"""

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import scalar
from reference.worlds import DOUBLE, drawing, random_scenes, scalar_cars

from ganlane.settings.driving import Visibility
from ganlane.sim import neighbours
from ganlane.sim.neighbours import FREE_GAP_M, follower, leader, perceive
from ganlane.sim.state import Road, Vehicles

ROWS = 20
SORT = 0
PAIRS = 10**12


def scenes(cars, lanes, seed, grid_m, dtype):
    """Cars, lorries and empty places, seen in all ways, of which on a coarse grid many stand level
    and as fast as others.
    """
    scene = random_scenes(ROWS, cars, lanes, seed)
    scene = Vehicles(*(field.to(dtype) if field.is_floating_point() else field for field in scene))
    between = drawing((ROWS, cars), seed + 1, dtype)
    return scene.with_(
        x=(between(-150, 150) / grid_m).round() * grid_m,
        heading=between(-0.1, 0.1),
        speed=between(0, 4).round() * 7.3,
        length=torch.where(between(0, 1) < 0.3, 12.0, 4.5).to(dtype),
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


def test_leader_and_follower_are_those_that_the_scalar_simulator_finds():
    """In every lane; gaps up to rounding."""
    vehicles = scenes(12, 3, seed=4, grid_m=2.5, dtype=DOUBLE)
    scene = perceive(vehicles, Road(lanes=3))
    lanes = torch.arange(3.0, dtype=DOUBLE).expand(ROWS, 12, 3)
    ahead, behind = leader(scene, lanes), follower(scene, lanes)
    for row in range(ROWS):
        cars = scalar_cars(vehicles, row)
        view = scalar.View(cars, scalar.Rules(lanes=3))
        for i, lane in itertools.product(range(12), range(3)):
            j = view.leader(i, lane)
            expected = (FREE_GAP_M, cars[i].speed) if j is None else (view.gap(i, j), cars[j].speed)
            seen = [field[row, i, lane].item() for field in ahead]
            assert seen == pytest.approx(expected)
            j = view.follower(i, lane)
            *seen, exists = (field[row, i, lane].item() for field in behind)
            assert exists == (j is not None)
            if exists:
                expected = view.gap(j, i), cars[j].speed, cars[j].desired_speed
                assert seen == pytest.approx(expected)
