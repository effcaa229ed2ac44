"""Lanes that end, of roads that differ between the rows of a batch."""

import random

import pytest
import torch
from reference.worlds import random_scenes, random_stretches

from ganlane.settings.road import EXIT, FAR_M, NOTHING, WALL, LaneStretch
from ganlane.sim.idm import following_acceleration
from ganlane.sim.lane_ends import (
    exists,
    from_start,
    hits_wall,
    room_before_wall,
    stretches_of_roads,
    stretches_of_row,
    ways_out,
)
from ganlane.sim.mobil import mobil_wishes
from ganlane.sim.neighbours import perceive
from ganlane.sim.state import Road, Vehicles, body_lanes, spanned

LANES = (2, 3, 5, 3, 4)
WIDTH_M = 3.6


@pytest.fixture(scope="module")
def roads():
    """Of as many lanes as ``LANES`` says; drivers of the second one may stay where they are."""
    rng = random.Random(3)
    drawn = [random_stretches(lanes, rng) for lanes in LANES]
    drawn[1] = (LaneStretch(),) * LANES[1]
    drawn[3] = (LaneStretch(100.0, 300.0, EXIT), *drawn[1][1:])
    return drawn


@pytest.fixture(scope="module")
def cars():
    """Some on each road, which drive in all of its lanes and on both sides of its ends."""
    rows = [random_scenes(1, 24, lanes, seed=row) for row, lanes in enumerate(LANES)]
    return Vehicles(*(torch.cat(fields) for fields in zip(*rows)))


FACTS = {
    "lanes exist": lambda cars, road: exists(road, cars.target_lane, cars.x),
    "a lane further to the left exists": lambda cars, road: exists(
        road, cars.target_lane[..., None] + torch.arange(3), cars.x[..., None]
    ),
    "room before the wall": lambda cars, road: room_before_wall(
        cars, spanned(body_lanes(cars, road))[..., :1], road
    ),
    "walls that are hit": lambda cars, road: hits_wall(cars, body_lanes(cars, road), road),
    # The ego's are others: with one road for all rows an exit is its mission.
    "sides to which lanes are left, and urgency": lambda cars, road: torch.stack(
        ways_out(cars, road, 500.0), dim=-1
    )[:, 1:],
    "accelerations": lambda cars, road: following_acceleration(perceive(cars, road)),
    "wishes of MOBIL": lambda cars, road: mobil_wishes(perceive(cars, road))[:, 1:],
}


@pytest.mark.parametrize("fact", FACTS)
def test_a_row_on_its_own_road_is_as_alone_on_that_road(fact, roads, cars):
    of_rows = Road(
        torch.tensor(LANES)[:, None],
        torch.full((len(LANES), 1), WIDTH_M, dtype=torch.float64),
        row_stretches=stretches_of_roads(roads),
    )
    together = FACTS[fact](cars, of_rows)
    differ = 0
    for row, lanes in enumerate(LANES):
        alone = cars.part([row])
        expected = FACTS[fact](alone, Road(lanes, WIDTH_M, stretches=roads[row]))
        assert torch.equal(together[row : row + 1], expected)
        # And the lanes' ends matter.
        endless = Road(lanes, WIDTH_M, stretches=(LaneStretch(),) * lanes)
        differ += not torch.equal(expected, FACTS[fact](alone, endless))
    assert differ >= 2


def test_the_lanes_of_a_row_are_read_back(roads):
    numbers = stretches_of_roads(roads)
    for row, lanes in enumerate(LANES):
        read = stretches_of_row(numbers, row)
        assert read[:lanes] == roads[row]
        assert {lane.end for lane in read[lanes:]} <= {NOTHING}


def test_from_another_start_only_what_is_near_moves():
    numbers = stretches_of_roads([(LaneStretch(end_m=300.0, end=WALL), LaneStretch())])
    moved = from_start(numbers, torch.tensor([[120.0]], dtype=torch.float64), torch.float32)
    assert moved.begin_m.tolist() == [[-FAR_M, -FAR_M]]
    assert moved.end_m.tolist() == moved.wall_m.tolist() == [[180.0, FAR_M]]
    assert moved.leave_by_m.tolist() == [[180.0, FAR_M]]
    assert moved.changes.tolist() == [[1.0, 1.0]]
