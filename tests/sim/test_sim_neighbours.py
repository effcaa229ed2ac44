"""Sorting finds the neighbours that comparing every pair finds, bit for bit, whatever stands level or abreast."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ganlane.parameters.driving import Visibility
from ganlane.sim import neighbours
from ganlane.sim.idm import TABLE_V
from ganlane.sim.mobil import TABLE_IV, _gives_way, one_at_a_time
from ganlane.sim.neighbours import follower, leader, perceive
from ganlane.sim.spawn import recycle
from ganlane.sim.state import Road, Vehicles

ROWS = 20
SORT, PAIRS = 0, 10**12


def scenes(cars: int, lanes: int, seed: int, grid_m: float, dtype: torch.dtype) -> Vehicles:
    """Cars, lorries and empty places, every third in a lane change; on a coarse grid many stand level."""
    generator = torch.Generator().manual_seed(seed)

    def between(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand((ROWS, cars), generator=generator, dtype=dtype)

    lane, zero = between(0, lanes).long(), torch.zeros((ROWS, cars), dtype=dtype)
    target = (lane + between(-1.5, 1.5).round().long()).clamp(0, lanes - 1)
    return Vehicles(
        x=(between(-150, 150) / grid_m).round() * grid_m,
        y=4.0 * (lane + (target - lane) * between(0, 1)),
        heading=between(-0.1, 0.1),
        speed=between(0, 4).round() * 7.3,
        acceleration=zero,
        length=torch.where(between(0, 1) < 0.3, 12.0, 4.5).to(dtype),
        width=zero + 2.5,
        desired_speed=between(15, 35),
        target_lane=target,
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
    road = Road(torch.full((ROWS, 1), lanes), torch.full((ROWS, 1), 4.0)) if own_roads else Road(lanes)
    asked = vehicles.target_lane[..., None] + torch.tensor([0.0, 1.0, -1.0])
    found = {}
    for way in (SORT, PAIRS):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(neighbours, "SORTS_FROM", way)
            scene = perceive(vehicles, road)
            assert (scene.queue is not None) == (way == SORT)
            found[way] = leader(scene, asked), follower(scene, asked)
    for ours, theirs in zip(*found.values()):
        exists = ours.gap < neighbours.FREE_GAP_M
        assert torch.equal(ours.gap, theirs.gap)
        assert torch.equal(ours.speed[exists], theirs.speed[exists])
    (_, behind), (_, others) = found.values()
    assert torch.equal(behind.desired_speed[behind.exists], others.desired_speed[others.exists])


def test_the_leader_has_the_nearest_rear_and_is_the_slowest_of_those():
    """Against a loop over the vehicles; gaps are of today's formula, up to rounding."""
    vehicles, lanes = scenes(12, 3, seed=4, grid_m=2.5, dtype=torch.float64), 3
    scene = perceive(vehicles, Road(lanes))
    number = vehicles.target_lane.double()
    found, (low, high) = leader(scene, number), scene.presence
    for row in range(ROWS):
        for i in range(12):
            ahead = [
                (scene.pairs.ahead[row, i, j].item(), vehicles.speed[row, j].item())
                for j in range(12)
                if scene.pairs.order[row, i, j] > 0 and low[row, j] <= number[row, i] <= high[row, j]
            ]
            expected = min(ahead, default=(neighbours.FREE_GAP_M, vehicles.speed[row, i].item()))
            assert (found.gap[row, i].item(), found.speed[row, i].item()) == expected


def test_on_a_ring_the_first_has_the_last_as_its_leader():
    vehicles = scenes(8, 1, seed=1, grid_m=1.0, dtype=torch.float64)
    vehicles = vehicles.with_(valid=torch.ones_like(vehicles.valid), length=torch.full_like(vehicles.x, 4.5))
    gap = leader(perceive(vehicles, Road(1, ring_m=300.0)), torch.zeros_like(vehicles.x)).gap
    first = vehicles.x.argmax(1, keepdim=True)
    around = vehicles.x.amin(1, keepdim=True) + 300.0 - vehicles.x.gather(1, first) - 4.5
    near = around[:, 0] < 145.0
    assert near.any()
    assert torch.equal(gap.gather(1, first)[near], around[near])


@pytest.mark.parametrize("seed", range(5))
def test_among_the_few_who_wish_the_same_give_way_as_among_all(seed):
    vehicles, road = scenes(20, 3, seed, grid_m=0.25, dtype=torch.float32), Road(3)
    wish = torch.randint(-1, 2, (ROWS, 20), generator=torch.Generator().manual_seed(seed)) * (vehicles.speed > 20)
    kept = one_at_a_time(perceive(vehicles, road), wish)
    assert torch.equal(kept, torch.where(_gives_way(vehicles, road, wish, TABLE_V, TABLE_IV), 0, wish))
    assert (kept != wish).any()
    assert (kept != 0).any()


def test_recycling_leaves_those_in_range_where_they_are():
    vehicles = scenes(9, 3, seed=2, grid_m=0.25, dtype=torch.float32)
    near = vehicles.with_(x=0.5 * vehicles.x)
    assert torch.equal(recycle(near, Road(3), TABLE_V).x, near.x)
