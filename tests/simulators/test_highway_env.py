"""HighwayEnv's drivers around our ego."""

import pytest
import torch

pytest.importorskip(
    "highway_env", reason="HighwayEnv is not installed: pip install 'ganlane[bench]'"
)

from reference.traffics import start
from reference.worlds import episode_keys, scalar_cars, step
from reference.worlds import vehicles as scene_of

from ganlane import keys
from ganlane.env import HighwayEnv
from ganlane.settings.driving import Visibility
from ganlane.sim.random import Purpose, uniform
from ganlane.sim.state import Vehicles
from ganlane_simulators import HighwayEnvTraffic


@pytest.fixture(scope="module")
def traffic():
    return HighwayEnvTraffic()


def test_a_step_is_that_of_highway_envs_own_road(traffic):
    """The same scene on a road built and stepped the way HighwayEnv's environments do it."""
    import numpy as np
    from highway_env.road.road import Road as TheirRoad
    from highway_env.road.road import RoadNetwork
    from highway_env.vehicle.behavior import IDMVehicle
    from highway_env.vehicle.controller import ControlledVehicle

    env = HighwayEnv(traffic, 1, dtype=torch.float64)
    state = start(env, [2])
    before = Vehicles.of(state[keys.VEHICLES])
    seen = []
    env.recorder = lambda vehicles, running: seen.append(vehicles)
    step(env, state)

    # Drivers' exponents, in HighwayEnv's range.
    key = episode_keys([2], traffic.stream)
    draws = uniform(key, 0, 9, [Purpose.FOREIGN_DRIVER + 8], torch.float64)[0, :, 0]
    road = TheirRoad(
        RoadNetwork.straight_road_network(3, start=-1000.0, length=9000.0, speed_limit=70.0)
    )
    for i, car in enumerate(scalar_cars(before, 0)):
        kind = IDMVehicle if i else ControlledVehicle
        vehicle = kind(road, [car.x, car.y], speed=car.speed, target_speed=car.desired_speed)
        vehicle.timer = state[keys.TRAFFIC, "timer"][0, i].item()
        vehicle.LENGTH = car.length
        vehicle.WIDTH = car.width
        vehicle.DELTA = 3.5 + draws[i].item()
        road.vehicles.append(vehicle)
    ego, *others = road.vehicles
    for after in seen[:8]:
        now, *expected = scalar_cars(before, 0)[:1] + scalar_cars(after, 0)[1:]
        ego.position = np.array([now.x, now.y])
        ego.heading, ego.speed = now.heading, now.speed
        road.act()
        for vehicle, car in zip(others, expected):
            vehicle.step(0.1)
            theirs = [*vehicle.position, vehicle.heading, vehicle.speed]
            assert [car.x, car.y, car.heading, car.speed] == pytest.approx(theirs, abs=1e-4)
        before = after


def test_a_state_can_be_branched(traffic):
    env = HighwayEnv(traffic, 1)
    state = step(env, start(env, [0]))
    first, second = (step(env, state)[keys.VEHICLES] for _ in range(2))
    assert (first == second).all()


def two(x_ego, ego=None, slow=None):
    """A fast driver in lane 0 at x = 0 behind a slow one, and an ego in lane 1 that is beside or
    behind it.
    """
    first = {"x": x_ego, "lane": 1, "desired_speed": 20.0, **(ego or {})}
    last = {"x": 30.0, "speed": 10.0, "desired_speed": 10.0, **(slow or {})}
    cars = ({"visibility": int(Visibility.BODY), **car} for car in (first, {"x": 0.0}, last))
    return scene_of(*cars, dtype=torch.float32)


def moved(traffic, scene):
    key = torch.zeros(1, dtype=torch.int64)
    return traffic.move(scene, {"timer": torch.zeros_like(scene.x)}, key, key)[0]


def test_a_follower_brakes_for_an_ego_that_stands_in_its_lane(traffic):
    # Seen from 1 m beyond the edge of the lane on, as HighwayEnv has it: y = 0.9 would do by our
    # rule, too.
    in_front, beside = (
        two(30.0, {"y": y, "speed": 5.0}, {"x": 300.0, "speed": 20.0}) for y in (0.9, 4.0)
    )
    assert moved(traffic, in_front).acceleration[0, 1] < -5.0
    assert moved(traffic, beside).acceleration[0, 1] > 0.0


def test_who_is_not_valid_is_nobodys_leader(traffic):
    assert moved(traffic, two(500.0)).acceleration[0, 1] < -3.0
    gone = moved(traffic, two(500.0, slow={"valid": False}))
    assert gone.acceleration[0, 1] > 0.0
    assert gone.x[0, 2] == 30.0
    assert not gone.valid[0, 2]
