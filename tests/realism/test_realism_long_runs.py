"""Long runs without an ego and the events in them, on traffic of which the numbers are known."""

import pytest
import torch

from ganlane.realism.driving import ConstantVelocity, RandomDriving
from ganlane.realism.long_runs import (
    EventCounter,
    LongRunParameters,
    long_run,
    spawned_vehicles,
    totals,
)
from ganlane.sim.random import episode_key
from ganlane.sim.state import Road
from ganlane.traffic import IdmTraffic

ROAD = Road()
SHORT = LongRunParameters(vehicles=6, vehicle_km=1.0, most_s=20.0)
BUSY = LongRunParameters(vehicles=9, vehicle_km=3.0, most_s=20.0)


def start(vehicles=9):
    """Three episodes; index 0 is nobody."""
    key = episode_key(2, torch.zeros(3, dtype=torch.int64), torch.arange(3))
    return spawned_vehicles(IdmTraffic(ROAD), LongRunParameters(vehicles=vehicles), key)


def test_all_but_the_ego_are_there_and_start_as_the_simulators_episodes_do():
    vehicles = start()
    assert vehicles.x.shape == (3, 10)
    assert not vehicles.valid[:, 0].any()
    assert vehicles.valid[:, 1:].all()
    assert ((vehicles.desired_speed[:, 1:] >= 18.0) & (vehicles.desired_speed[:, 1:] <= 26.0)).all()
    many = start(30).x
    # 31 places at the paper's density, on 200 m for 9, around the ego's.
    assert 400 < many.amax() - many.amin() < 1378


def test_constant_velocity_keeps_every_speed_and_changes_no_lane():
    # 20 s of six vehicles in each episode.
    run = long_run(ConstantVelocity, ROAD, SHORT)
    assert run["vehicle_km"] >= 1.0
    assert run["lane_changes"] == run["off_road"] == run["standstills_in_free_flow"] == 0
    assert run["acceleration_quantiles"]["0.95"] == pytest.approx(0.0, abs=0.01)
    assert run["speeds"]["10 s"]["mean_speed_mps"] == pytest.approx(
        1000 * run["vehicle_km"] / (20 * 6 * run["episodes"]), rel=1e-3
    )
    assert run["speeds"]["60 s"] == {"mean_speed_mps": None, "spread_mps": None, "episodes": 0}


@pytest.fixture(scope="module")
def blind():
    """A run in which nobody looks at anybody."""
    return long_run(RandomDriving, ROAD, BUSY)


def test_blind_driving_overlaps_and_careful_driving_does_not(blind):
    assert blind["overlaps"] > 0
    assert blind["lane_changes"] > 0
    low, high = blind["overlaps_per_1000_vehicle_km_ci"]
    assert low < blind["overlaps_per_1000_vehicle_km"] < high
    assert long_run(IdmTraffic, ROAD, BUSY)["overlaps"] == 0


def test_totals_add_counts_up_and_know_nothing_of_nothing(blind):
    runs = [blind, long_run(RandomDriving, ROAD, SHORT)]
    km, overlaps, off_road = (
        sum(run[name] for run in runs) for name in ("vehicle_km", "overlaps", "off_road")
    )
    assert totals(runs)["overlaps_per_1000_vehicle_km"] == pytest.approx(1000 * overlaps / km)
    assert totals(runs)["off_road"] == off_road
    assert totals([])["off_road"] is totals([])["lane_changes_per_vehicle_km"] is None


def in_line(spacing_m, speed_mps):
    """Three rows of ten vehicles in the first lane; index 0 is nobody."""
    # From the rearmost to the foremost.
    x = spacing_m * torch.arange(10.0).expand(3, 10)
    return start().with_(x=x, y=torch.zeros_like(x), speed=torch.full_like(x, speed_mps))


def test_events_are_counted_when_they_begin_and_the_ego_which_is_not_there_meets_nobody():
    apart = in_line(100.0, 20.0)
    counter = EventCounter(ROAD)
    index = torch.arange(10)
    touching = apart.with_(x=torch.where(index == 2, apart.x - 98.0, apart.x))
    outside = apart.with_(y=torch.where(index == 3, -1.0, 0.0).expand(3, 10))
    for at in (apart, touching, touching, apart, touching):
        counter.count(at, 0)
    # In each of three rows the second and the first vehicle meet, twice.
    assert (counter.overlaps, counter.off_road) == (6, 0)
    # The place of the ego, which is not there.
    on_top = apart.with_(x=torch.where(index == 0, apart.x[:, 1:2], apart.x))
    for at in (outside, outside, on_top):
        counter.count(at, 0)
    assert (counter.overlaps, counter.off_road) == (6, 3)


def test_standing_in_a_queue_is_no_standstill_but_standing_alone_is():
    queue = in_line(20.0, 0.0)
    counter = EventCounter(ROAD)
    for step, expected in ((8, 0), (9, 3), (19, 3)):  # only the foremost has nobody ahead
        counter.count(queue, step)
        assert counter.standstills == expected
