"""Traffic has no crashes of its own making.

Alone, or with an ego that keeps its lane or signals.
"""

import random
from dataclasses import asdict

import pytest
import torch
from reference.marks import slow
from reference.traffics import all_faults, keep_lane
from reference.worlds import random_environment

import ganlane
from ganlane import keys
from ganlane.agents.drivers import KeepLaneDriver, MobilDriver
from ganlane.settings.driving import Visibility
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.state import Road, Vehicles

ROWS = 16


class Watch:
    """Looks at every physics step: nobody overlaps, leaves the road or drives backwards.

    ``first`` is the first vehicle of a row that it looks at, 0 the ego; ``km`` is what the others
    have driven.
    """

    def __init__(self, road: Road, first: int = 0) -> None:
        self.road = road
        self.first = first
        self.km = 0.0

    def __call__(self, now: Vehicles, running: torch.Tensor) -> None:
        now = now.part(running)
        self.km += (now.speed * now.valid)[:, 1:].sum().item() * keys.PHYSICS_STEP_S / 1000.0
        now = now.columns(slice(self.first, None))
        assert not pair_overlaps(now).any()
        assert (now.y >= self.road.right_edge_m()).all()
        assert (now.y <= self.road.left_edge_m()).all()
        assert (now.speed >= 0.0).all()


def drive(rng: random.Random, most_vehicles: int, duration_s: float) -> float:
    """One random road with random traffic, ``ROWS`` episodes of it: the vehicle-km driven.

    In a third of them it is alone, with no ego.
    """
    env = random_environment(
        rng,
        ROWS,
        most_vehicles=most_vehicles,
        spacings_m=(6.0, 8.0, 12.0, 25.0),
        visibility=Visibility.SIGNALLED,
        goal_m=5000.0,
        timeout_s=duration_s,
        kernel="auto",
    )
    driver = (MobilDriver if rng.random() < 0.5 else KeepLaneDriver)(env.road)
    env.recorder = watch = Watch(env.road)
    td = env.reset()
    td[keys.VEHICLES, "valid"][:, 0] = rng.random() > 1 / 3
    for _ in range(round(duration_s / env.episode.decision_period_s)):
        td = env.step(driver(td))["next"]
        assert not td[keys.EVENTS, "hard_crash"].any()
        assert not td[keys.EVENTS, "out_of_road"].any()
    return watch.km


@pytest.mark.parametrize(
    ("vehicle_km", "roads", "most_vehicles", "duration_s"),
    [(100.0, 15, 30, 8.0), slow(10_000.0, 30, 60, 60.0)],
)
def test_no_overlap_in_so_many_km_on_so_many_roads(vehicle_km, roads, most_vehicles, duration_s):
    rng = random.Random(0)
    km = 0.0
    while km < vehicle_km or roads > 0:
        km += drive(rng, most_vehicles, duration_s)
        roads -= 1


LORRIES = {"truck_share": 0.4}
#: The road stays full.
RECYCLED = {"recycle": True}
CROWD = {"vehicles": 14, "spread_m": 300.0}
#: Ten times the default rates and more.
FAULTS = {"name": "idm_faults", **asdict(all_faults(120.0, 0.5))}


@pytest.mark.parametrize(
    ("traffic", "rows", "options", "vehicle_km"),
    [
        ("idm", 32, LORRIES, 170.0),
        ("idm_mobil", 32, LORRIES | RECYCLED, 170.0),
        ("gan_calibrated", 8, LORRIES, 40.0),
        ("idm_random", 64, CROWD, 500.0),
        (FAULTS, 24, CROWD | RECYCLED, 100.0),
        slow("idm", 64, LORRIES | RECYCLED, 1760.0),
        slow("idm_mobil", 64, LORRIES | RECYCLED, 1800.0),
        slow("gan_calibrated", 48, LORRIES | RECYCLED, 840.0),
        slow("idm_faults", 128, CROWD | RECYCLED, 5000.0),
    ],
    ids=str,
)
def test_nobody_overlaps_another_or_an_ego_that_keeps_its_lane(traffic, rows, options, vehicle_km):
    env = ganlane.make_env(traffic, rows, **options).base_env
    # Drivers who make mistakes may run into the ego.
    env.recorder = watch = Watch(env.road, first=1 if "faults" in str(traffic) else 0)
    td = env.reset()
    while watch.km < vehicle_km:
        _, td = env.step_and_maybe_reset(td.set(keys.ACTION, keep_lane(td)))
