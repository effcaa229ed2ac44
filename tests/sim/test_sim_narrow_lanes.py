"""In narrow lanes a body that is turned stands in three lanes at once, and its driver looks into all of them.

A second lane change right after a first one makes it so: the rear is still in the lane that it comes from, the driver
wants into the one after the next, and a slow car drives in the lane between.
"""

from __future__ import annotations

import pytest
import torch
from reference.worlds import DOUBLE

from ganlane.parameters.driving import Visibility
from ganlane.sim import idm
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.idm import idm_acceleration
from ganlane.sim.state import ARRIVED_M, LaneRange, Road, Vehicles, body_lanes, spanned, with_target
from ganlane.traffic.idm_mobil import IdmTraffic

CHANGES, SLOWER = 0, 1
DESIRED_MPS = 25.0
SECONDS = 15


def lowest_and_highest(between: LaneRange) -> torch.Tensor:
    """:func:`ganlane.sim.state.spanned` without the lane in the middle."""
    return torch.stack((between.low, between.low, between.high), dim=-1)


def first_changes(lane_width_m: float, length_m: float, scenes: int = 20_000) -> Vehicles:
    """One changes from lane 0 to lane 1, where a slower one is 2 to 32 m ahead; IDM asks for less than 4 m/s2."""
    generator = torch.Generator().manual_seed(0)

    def between(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(scenes, generator=generator, dtype=DOUBLE)

    speed = between(0.5, 12.0)
    slower = (speed - between(0.0, 6.0)).clamp_min(0.05)
    gap = 2.0 + between(0.0, 30.0)
    calm = idm_acceleration(speed, torch.full_like(speed, DESIRED_MPS), gap, slower) > -4.0
    speed, slower, gap = speed[calm], slower[calm], gap[calm]
    x = torch.stack((torch.zeros_like(gap), gap + length_m), dim=1)
    zero, lane = torch.zeros_like(x), torch.tensor([0, 1]).expand(len(gap), 2)
    return Vehicles(
        x=x,
        y=lane * lane_width_m,
        heading=zero,
        speed=torch.stack((speed, slower), dim=1),
        acceleration=zero,
        length=zero + length_m,
        width=zero + 2.5,
        desired_speed=torch.stack((torch.full_like(slower, DESIRED_MPS), slower + 0.01), dim=1),
        target_lane=torch.ones_like(lane),
        visibility=torch.full_like(lane, int(Visibility.SIGNALLED)),
        valid=lane >= 0,
    )


def drive(lane_width_m: float, length_m: float = 4.5) -> tuple[int, int, int]:
    """Scenes, those in which the two overlap, those in which the one that changes stands in three lanes."""
    road = Road(lanes=3, lane_width_m=lane_width_m)
    cars, traffic = first_changes(lane_width_m, length_m), IdmTraffic(road)
    clock = torch.zeros(len(cars.x), dtype=torch.int64)
    memory = traffic.fresh_memory(cars, clock)
    hit = three = torch.zeros(len(cars.x), dtype=torch.bool)
    for _ in range(10 * SECONDS):
        cars = with_second_change(cars, lane_width_m)
        attends = with_target(body_lanes(cars, road), cars)
        three = three | (attends.high - attends.low >= 2)[:, CHANGES]
        cars, memory = traffic.move(cars, memory, clock, clock)
        hit = hit | pair_overlaps(cars)[:, CHANGES, SLOWER]
    return len(cars.x), int(hit.sum()), int(three.sum())


def with_second_change(cars: Vehicles, lane_width_m: float) -> Vehicles:
    """On to lane 2 in the moment that the change to lane 1 counts as complete."""
    arrived = (cars.y - lane_width_m).abs() < ARRIVED_M
    goes_on = arrived & (cars.target_lane == 1) & (torch.arange(2) == CHANGES)
    return cars.with_(target_lane=torch.where(goes_on, 2, cars.target_lane))


@pytest.mark.parametrize(
    ("lane_width_m", "length_m"),
    [
        (2.55, 4.5),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in ((3.5, 12.0), (2.7, 4.5), (2.9, 4.5), (3.0, 4.5))),
    ],
)
def test_who_changes_two_lanes_in_a_row_does_not_touch_the_slower_car_in_between(lane_width_m, length_m):
    scenes, overlaps, three = drive(lane_width_m, length_m)
    assert scenes > 15_000
    assert three > 1000
    assert overlaps == 0


@pytest.mark.parametrize(
    ("lane_width_m", "before"),
    [(2.55, 229), *(pytest.param(*case, marks=pytest.mark.slow) for case in ((2.7, 157), (2.9, 66), (3.0, 7)))],
)
def test_with_the_lowest_and_the_highest_lane_alone_it_would(lane_width_m, before, monkeypatch):
    """The figures of docs/simulator.md: so the test above can fail."""
    monkeypatch.setattr(idm, "spanned", lowest_and_highest)
    scenes, overlaps, _ = drive(lane_width_m)
    assert scenes == 15_937
    assert overlaps == pytest.approx(before, abs=3)


def test_the_lanes_of_a_range_are_its_ends_and_the_one_after_the_lowest():
    low, high = torch.tensor([1.0, 1.0, 1.0]), torch.tensor([1.0, 2.0, 3.0])
    assert spanned(LaneRange(low, high)).tolist() == [[1, 1, 1], [1, 2, 2], [1, 2, 3]]
