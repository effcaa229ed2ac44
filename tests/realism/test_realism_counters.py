"""What is counted while traffic drives, on scenes worked out by hand."""

import pytest
import torch

from ganlane.realism.counters import EventCounter, GuardMeter, watched
from ganlane.realism.long_runs import LongRunParameters, spawned_vehicles
from ganlane.sim.random import episode_key
from ganlane.sim.state import Road
from ganlane.traffic import Guard, IdmTraffic, TrafficModule


def start(road):
    """Three episodes of nine vehicles; index 0 is nobody."""
    key = episode_key(2, torch.zeros(3, dtype=torch.int64), torch.arange(3))
    return spawned_vehicles(IdmTraffic(road), LongRunParameters(), key)


def test_events_are_counted_when_they_begin():
    road = Road()
    vehicles, counter = start(road), EventCounter(road)
    x = 100.0 * torch.arange(10.0).expand(3, 10)
    apart = vehicles.with_(x=x, y=torch.zeros_like(x), speed=torch.full_like(x, 20.0))
    touching = apart.with_(x=torch.where(torch.arange(10) == 2, x - 98.0, x))
    outside = apart.with_(y=torch.where(torch.arange(10) == 3, -1.0, 0.0).expand(3, 10))
    for at in (apart, touching, touching, apart, touching):
        counter.count(at, 0)
    # In each of three rows the second and the first vehicle meet, twice.
    assert (counter.overlaps, counter.off_road) == (6, 0)
    for at in (outside, outside):
        counter.count(at, 0)
    assert counter.off_road == 3


def test_standing_in_a_queue_is_no_standstill_but_standing_alone_is():
    road = Road()
    vehicles = start(road)
    x = 20.0 * torch.arange(10.0).expand(3, 10)
    queue = vehicles.with_(x=x, y=torch.zeros_like(x), speed=torch.zeros_like(x))
    counter = EventCounter(road)
    counter.count(queue, 8)
    assert counter.standstills == 0
    counter.count(queue, 9)
    # Only the foremost has nobody ahead.
    assert counter.standstills == 3
    counter.count(queue, 19)
    assert counter.standstills == 3


def test_the_ego_which_is_not_there_meets_nobody():
    road = Road()
    vehicles, counter = start(road), EventCounter(road)
    x = 100.0 * torch.arange(10.0).expand(3, 10)
    on_top = vehicles.with_(x=torch.where(torch.arange(10) == 0, x[:, 1:2], x), y=torch.zeros_like(x))
    counter.count(on_top, 0)
    assert counter.overlaps == 0


class Swerver(TrafficModule):
    """Brakes hard with vehicle 1, moves vehicle 2 aside."""

    def move(self, vehicles, memory, key, step):
        index = torch.arange(vehicles.x.shape[1])
        speed = vehicles.speed - torch.where(index == 1, 2.0, 0.0)
        return vehicles.with_(speed=speed, y=vehicles.y + torch.where(index == 2, 0.5, 0.0)), memory


def test_the_guard_meter_counts_what_the_guard_alters_and_lets_go_afterwards():
    guard, meter = Guard(Road()), GuardMeter()
    vehicles = start(Road())
    x = 200.0 * torch.arange(10.0).expand(3, 10)
    vehicles = vehicles.with_(x=x, speed=torch.full_like(x, 15.0))
    moved, _ = Swerver().move(vehicles, {}, torch.zeros(3), torch.zeros(3))
    assert meter.share is None
    with watched(guard, meter):
        guarded, _ = guard.rewrite(vehicles, moved, {}, torch.zeros(3), torch.zeros(3))
    assert guard.observer is None
    # Vehicle 1 brakes with 20 m/s2, vehicle 2 moves by 0.5 m of which a fifth is damped; the other seven do neither.
    assert meter.share == pytest.approx(2 / 9)
    unwatched, _ = guard.rewrite(vehicles, moved, {}, torch.zeros(3), torch.zeros(3))
    assert torch.equal(unwatched.x, guarded.x)
