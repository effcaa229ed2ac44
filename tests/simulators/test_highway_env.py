"""HighwayEnv's drivers around our ego."""

import pickle

import pytest
import torch
from reference.refusals import user_error

pytest.importorskip(
    "highway_env",
    reason="HighwayEnv is not installed: pip install 'ganlane[bench]'",
)

from reference.foreign import assert_same_alone, drive, overlaps, start
from reference.worlds import vehicles as scene_of

from ganlane import keys
from ganlane.env import HighwayEnv
from ganlane.settings.driving import Visibility
from ganlane.sim.random import Purpose, episode_key, uniform
from ganlane.sim.state import Road, Vehicles
from ganlane_simulators import HighwayEnvTraffic

KEEP = torch.zeros(1, dtype=torch.int64)


@pytest.fixture(scope="module")
def traffic():
    return HighwayEnvTraffic()


@pytest.fixture(scope="module")
def driven(traffic):
    """Four egos that keep their lanes, for 30 s: vehicles [301, 4, 9]."""
    vehicles, running, state = drive(HighwayEnv(traffic, 4), range(4), 30)
    assert running.all()
    return vehicles, state


def test_an_ego_that_keeps_its_lane_crashes_with_nobody_and_nobody_with_another(
    driven,
):
    vehicles, state = driven
    assert not state[keys.EVENTS]["hard_crash"].any()
    assert overlaps(vehicles) == 0


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
    env.step(state.set(keys.ACTION, KEEP))

    # Drivers' exponents, in HighwayEnv's range.
    key = episode_key(traffic.stream, torch.tensor([0]), torch.tensor([2]))
    draws = uniform(key, 0, 9, [Purpose.FOREIGN_DRIVER + 8], torch.float64)[0, :, 0]
    exponent = (3.5 + draws).tolist()
    road = TheirRoad(
        RoadNetwork.straight_road_network(3, start=-1000.0, length=9000.0, speed_limit=70.0)
    )
    for i in range(9):
        place = [before.x[0, i].item(), before.y[0, i].item()]
        speeds = before.speed[0, i].item(), before.desired_speed[0, i].item()
        kind = IDMVehicle if i else ControlledVehicle
        vehicle = kind(road, place, speed=speeds[0], target_speed=speeds[1])
        vehicle.timer = state[keys.TRAFFIC, "timer"][0, i].item()
        vehicle.LENGTH = 4.5
        vehicle.WIDTH = 2.5
        vehicle.DELTA = exponent[i]
        road.vehicles.append(vehicle)
    ego, *others = road.vehicles
    for count, after in enumerate(seen[:8]):
        ego.position = np.array([before.x[0, 0].item(), before.y[0, 0].item()])
        ego.heading = before.heading[0, 0].item()
        ego.speed = before.speed[0, 0].item()
        road.act()
        for vehicle in others:
            vehicle.step(0.1)
        theirs = [[*vehicle.position, vehicle.heading, vehicle.speed] for vehicle in others]
        ours = torch.stack((after.x, after.y, after.heading, after.speed), dim=-1)[0, 1:]
        torch.testing.assert_close(
            ours, torch.tensor(theirs), rtol=1e-6, atol=1e-4, check_dtype=False, msg=f"step {count}"
        )
        before = after


def test_an_episode_is_the_same_alone_and_beside_others(traffic):
    assert_same_alone(HighwayEnv, traffic, [1, 3], 12)


def test_a_state_can_be_branched(traffic):
    env = HighwayEnv(traffic, 1)
    state = env.step(start(env, [0]).set(keys.ACTION, KEEP))["next"].clone()
    first, second = (
        env.step(state.clone().set(keys.ACTION, KEEP))["next", keys.VEHICLES] for _ in range(2)
    )
    assert (first == second).all()


def two(x_ego, ego=None, slow=None):
    """A fast driver in lane 0 at x = 0 behind a slow one, and an ego in lane 1 that is beside or
    behind it.
    """
    first = {"x": x_ego, "lane": 1, "desired_speed": 20.0, **(ego or {})}
    last = {"x": 30.0, "speed": 10.0, "desired_speed": 10.0, **(slow or {})}
    cars = ({"visibility": int(Visibility.BODY), **car} for car in (first, {"x": 0.0}, last))
    return scene_of(*cars, dtype=torch.float32)


def moved(traffic, scene, timer=0.0):
    key = torch.zeros(1, dtype=torch.int64)
    return traffic.move(scene, {"timer": torch.full_like(scene.x, timer)}, key, key)[0]


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


def test_a_copy_drives_on(traffic):
    copy = pickle.loads(pickle.dumps(traffic))
    assert all(
        map(
            torch.equal,
            moved(traffic, two(-60.0)),
            moved(copy, two(-60.0)),
        )
    )


def test_a_ring_is_refused():
    with user_error("ring of 500 m"):
        HighwayEnvTraffic(Road(ring_m=500.0))
