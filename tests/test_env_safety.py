"""Rule-driven traffic has no crashes of its own making.

Alone, or with an ego that keeps its lane or signals.
"""

import random
from dataclasses import replace

import pytest
import torch
from reference.worlds import environment

from ganlane import keys
from ganlane.agents.drivers import KeepLaneDriver, MobilDriver
from ganlane.settings.driving import Visibility
from ganlane.settings.episode import SpawnParameters
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.state import Vehicles

ROWS = 16


def sparse(vehicles: int, lanes: int) -> SpawnParameters:
    """Table II, its spread grown with the number of vehicles."""
    return SpawnParameters(spread_m=max(200.0, 25.0 * (vehicles / lanes + 2)))


def dense(rng: random.Random, vehicles: int, lanes: int) -> SpawnParameters:
    """Up to a jam: speeds no higher than what the smallest gap allows to brake from."""
    spacing = rng.choice([6.0, 8.0, 12.0])
    speeds = (0.0, min(rng.choice([1.0, 3.0, 8.0]), 1.2 * (spacing - 4.5)))
    return SpawnParameters(
        spread_m=vehicles / lanes * spacing * rng.uniform(1.1, 3.0) + spacing,
        min_spacing_m=spacing,
        front_speed_mps=speeds,
        rear_speed_mps=speeds,
        ego_speed_mps=speeds,
    )


def crawling(p: SpawnParameters, rng: random.Random) -> SpawnParameters:
    """Drivers of very different desired speeds: queues behind the slow ones."""
    return replace(p, desired_speed_mps=(rng.choice([1.0, 5.0]), rng.choice([8.0, 36.0])))


def drive(rng: random.Random, most_vehicles: int, duration_s: float) -> float:
    """One random road with random traffic, ``ROWS`` episodes of it: the vehicle-km driven.

    In a third of them it is alone, with no ego. Nobody overlaps, leaves the road or drives
    backwards.
    """
    lanes = rng.randint(1, 6)
    vehicles = rng.randint(2, most_vehicles)
    spawn = dense(rng, vehicles, lanes) if rng.random() < 0.5 else sparse(vehicles, lanes)
    spawn = crawling(spawn, rng) if rng.random() < 0.4 else spawn
    period_s = rng.choice([0.1, 0.2, 0.5, 1.0, 2.0])
    env = environment(
        lanes,
        ROWS,
        vehicles,
        mobil=rng.random() < 0.8,
        period_s=period_s,
        timeout_s=duration_s,
        visibility=Visibility.SIGNALLED,
        spawn=spawn,
        seed=rng.randrange(10**9),
        dtype=torch.float32,
        recycle=rng.random() < 0.5,
        kernel="auto",
    )
    driver = (MobilDriver if rng.random() < 0.5 else KeepLaneDriver)(env.road)
    km = 0.0

    def record(now: Vehicles, running: torch.Tensor) -> None:
        nonlocal km
        driven = now.speed * (now.valid & running[:, None])
        km += driven.sum().item() * keys.PHYSICS_STEP_S / 1000.0
        assert not pair_overlaps(now)[running].any()
        assert (now.y >= env.road.right_edge_m()).all()
        assert (now.y <= env.road.left_edge_m()).all()
        assert (now.speed >= 0.0).all()

    env.recorder = record
    td = env.reset()
    td[keys.VEHICLES, "valid"][:, 0] = rng.random() > 1 / 3
    for _ in range(round(duration_s / period_s)):
        td = env.step(driver(td))["next"]
        assert not td[keys.EVENTS, "hard_crash"].any()
        assert not td[keys.EVENTS, "out_of_road"].any()
    return km


@pytest.mark.parametrize(
    ("vehicle_km", "roads", "most_vehicles", "duration_s"),
    [(100.0, 15, 30, 8.0), pytest.param(10_000.0, 30, 60, 60.0, marks=pytest.mark.slow)],
)
def test_no_overlap_in_so_many_km_on_so_many_roads(vehicle_km, roads, most_vehicles, duration_s):
    rng = random.Random(0)
    km = 0.0
    while km < vehicle_km or roads > 0:
        km += drive(rng, most_vehicles, duration_s)
        roads -= 1
