"""Roads whose lanes begin and end: what drivers do there, and what the ego may."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from reference.worlds import environment, moves, placed, step, vehicles

import ganlane
from ganlane import keys
from ganlane.agents.drivers import MobilDriver
from ganlane.build import make_driver, make_env, make_traffic
from ganlane.env import HighwayEnv
from ganlane.errors import ParameterError, UserError
from ganlane.evaluation.episodes import ego_at_fault
from ganlane.settings.commands import DrivingConfig
from ganlane.settings.driving import MobilParameters
from ganlane.settings.env import EnvConfig
from ganlane.settings.record import make
from ganlane.settings.road import EXIT, WALL, LaneStretch, Stretches
from ganlane.settings.traffic import HumanTrafficConfig, IdmMobilTrafficConfig, IdmTrafficConfig
from ganlane.sim.dynamics import ego_scene
from ganlane.sim.idm import TABLE_V
from ganlane.sim.lane_ends import ways_out
from ganlane.sim.mobil import TABLE_IV, letting_past
from ganlane.sim.neighbours import perceive
from ganlane.sim.state import Road, Vehicles
from ganlane.traffic.base import TrafficModule
from ganlane.traffic.idm_mobil import IdmMobilTraffic, IdmTraffic
from ganlane.transforms import ActionMaskTransform

#: The right lane of two ends 400 m ahead.
DROP: Stretches = (LaneStretch(end_m=400.0, end=WALL), LaneStretch())
DROPPED = Road(2, stretches=DROP)
#: Beside a car that begins 200 m ahead.
LATE = Road(2, stretches=(LaneStretch(200.0, 400.0, WALL), LaneStretch()))
#: Half a car's length.
HALF_M = 2.25


# Who drives towards the end of a lane


def test_a_driver_that_keeps_its_lane_stops_some_17_metres_before_its_end():
    """IDM's gap of 2 m to a standing car, and 15 m to turn out; from four speeds."""
    one = vehicles({"x": 0.0, "desired_speed": 36.0}, {"x": -500.0, "lane": 1})
    cars = Vehicles(*(field.repeat(4, 1) for field in one))
    cars.speed[:, 0] = torch.tensor([5.0, 15.0, 25.0, 35.0])
    *_, last = moves(IdmTraffic(DROPPED), cars, 1500)
    room = 400.0 - (last.x[:, 0] + HALF_M)
    assert ((room > 16.5) & (room < 17.5)).all()
    assert (last.speed[:, 0] < 0.1).all()


def test_a_car_that_stands_at_the_end_turns_out_as_soon_as_the_lane_is_free():
    """Its body is out of the lane before its front is at the wall."""
    cars = vehicles({"x": -900.0, "lane": 1}, {"x": 400.0 - 17.0 - HALF_M, "speed": 0.0})
    for now in moves(IdmMobilTraffic(DROPPED), cars, 300):
        beside_the_wall = now.x[0, 1] + HALF_M > 400.0
        assert not beside_the_wall or now.y[0, 1] > 2.0 + 1.25 - 0.1
    assert now.x[0, 1] > 430.0


# The ego


def late_road(speed: float, x: float = 0.0) -> tuple[HighwayEnv, object]:
    """The ego alone in a lane that begins at 200 m and ends at 400 m."""
    env = environment(lanes=2, vehicles=2, stretches=LATE.stretches)
    cars = ({"x": x, "speed": speed}, {"x": -900.0, "lane": 1})
    return env, placed(env, vehicles(*cars))


def test_a_command_to_where_no_lane_is_leaves_the_road():
    env, td = late_road(10.0)
    assert step(env, td, keys.LEFT)[keys.EVENTS, "out_of_road"]
    env, td = late_road(10.0, x=210.0)
    after = step(env, td, keys.LEFT)
    assert not after["done"]
    assert after[keys.VEHICLES, "target_lane"][0, 0] == 1


@pytest.mark.parametrize("form", ["legal", "safe"])
def test_the_mask_knows_where_lanes_are(form):
    mask = ActionMaskTransform(LATE, form, idm=TABLE_V)
    for x, left in ((0.0, False), (210.0, True)):
        cars = vehicles({"x": x, "speed": 10.0}, {"x": -900.0, "lane": 1})
        allowed, _ = mask.allowed(cars, torch.zeros(1, dtype=torch.int64), LATE)
        assert allowed[0].tolist() == [True, left, False]


def test_the_safe_mask_sees_a_wall_as_a_standing_car():
    """At 25 m/s, 60 m before the end of the lane on the right: braking with more than 4 m/s2."""
    mask = ActionMaskTransform(DROPPED, "safe", idm=TABLE_V)
    for x, right in ((340.0, False), (0.0, True)):
        cars = vehicles({"x": x, "lane": 1, "speed": 25.0}, {"x": -900.0, "lane": 1})
        allowed, _ = mask.allowed(cars, torch.zeros(1, dtype=torch.int64), DROPPED)
        assert allowed[0].tolist() == [True, False, right]


@pytest.mark.parametrize("kernel", ["torch", "native"])
def test_driving_into_the_end_of_a_lane_is_a_hard_crash(kernel):
    """20 m before it nobody stops from 40 m/s."""
    env = environment(
        lanes=2, vehicles=2, stretches=LATE.stretches, dtype=torch.float32, kernel=kernel
    )
    cars = ({"x": 380.0 - HALF_M, "speed": 40.0}, {"x": -900.0, "lane": 1})
    td = placed(env, vehicles(*cars, dtype=torch.float32))
    after = step(env, td)
    assert after[keys.EVENTS, "hard_crash"]
    assert after["terminated"]
    assert 400.0 < after[keys.VEHICLES, "x"][0, 0] + HALF_M < 404.0


@pytest.mark.parametrize(("lane", "at_fault"), [(0, True), (1, False)])
def test_who_drives_into_a_wall_is_at_fault(lane, at_fault):
    cars = vehicles({"x": 399.0, "lane": lane}, {"x": -900.0, "lane": 1})
    assert bool(ego_at_fault(cars, DROPPED)) == at_fault


# Who has to change its lane


#: The right lane of two leaves the road 400 m ahead.
LEAVING: Stretches = (LaneStretch(end_m=400.0, end=EXIT), LaneStretch())


@pytest.mark.parametrize("kernel", ["torch", "native"])
@pytest.mark.parametrize(("courtesy", "end"), [(2.0, "goal"), (0.0, "missed_exit")])
def test_an_ego_beside_a_car_as_fast_as_it_falls_behind_and_takes_the_exit(kernel, courtesy, end):
    env = HighwayEnv(
        IdmTraffic(Road(2, stretches=LEAVING)),
        vehicles=2,
        kernel=kernel,
        mobil=MobilParameters(courtesy=courtesy),
    )
    alike = {"speed": 20.0, "desired_speed": 20.0}
    cars = vehicles({"x": 0.0, "lane": 1, **alike}, {"x": 1.0, **alike}, dtype=torch.float32)
    driver = MobilDriver(env.road)
    td = placed(env, cars)
    while not td["done"].any():
        td = step(env, td, driver(td)["action"])
    assert td[keys.EVENTS, end]


@pytest.mark.parametrize("kernel", ["torch", "native"])
@pytest.mark.parametrize("behind_m", [1.0, 5.0, 12.0])
@pytest.mark.parametrize("mirrored", [False, True])
def test_an_ego_just_ahead_of_a_car_as_fast_that_makes_no_room_lets_it_past_and_takes_the_exit(
    kernel, behind_m, mirrored
):
    stretches = LEAVING[::-1] if mirrored else LEAVING
    exit_lane = 1 if mirrored else 0
    env = HighwayEnv(IdmTraffic(Road(2, stretches=stretches)), vehicles=2, kernel=kernel)
    alike = {"speed": 20.0, "desired_speed": 20.0}
    ego = {"x": 0.0, "lane": 1 - exit_lane, **alike}
    cars = vehicles(ego, {"x": -behind_m, "lane": exit_lane, **alike}, dtype=torch.float32)
    driver = MobilDriver(env.road)
    td = placed(env, cars)
    while not td["done"].any():
        td = step(env, td, driver(td)["action"])
    assert td[keys.EVENTS, "goal"]
    assert td[keys.VEHICLES, "x"][0, 1] > td[keys.VEHICLES, "x"][0, 0]


@pytest.mark.parametrize(
    ("speed", "faster", "acceleration", "waits"),
    [
        (20.0, 0.0, 0.0, True),
        (20.0, 1.9, 0.0, True),
        (20.0, 2.1, 0.0, False),
        (20.0, 0.0, -0.9, True),
        (20.0, 0.0, -1.1, False),
        (0.0, 0.0, 0.0, False),
    ],
)
def test_an_ego_waits_for_nobody_who_is_faster_or_brakes_or_stands(
    speed, faster, acceleration, waits
):
    """One who is faster goes past; one who brakes or stands may wait for the ego."""
    road = Road(2, stretches=LEAVING)
    ego = {"x": 300.0, "lane": 1, "speed": speed}
    other = {"x": 299.0, "speed": speed + faster, "acceleration": acceleration}
    cars = vehicles(ego, other)
    scene = ego_scene(cars, road)
    ways = ways_out(scene.observers, road, TABLE_IV.mandatory_m)
    assert letting_past(scene, ways, TABLE_V, TABLE_IV)[0, 0] == (-2.0 if waits else torch.inf)


@pytest.mark.parametrize(("courtesy", "braking"), [(2.0, 2.0), (0.0, 0.0)])
def test_who_is_behind_one_who_has_to_change_makes_room(courtesy, braking):
    """Two in neighbouring lanes, as fast, the one ahead 100 m before the end of its lane."""
    alike = {"speed": 15.0, "desired_speed": 15.0}
    nobody = {"x": -900.0, "lane": 1}
    ahead = {"x": 300.0, **alike}
    behind = {"x": 290.0, "lane": 1, **alike}
    traffic = IdmMobilTraffic(DROPPED, mobil=MobilParameters(courtesy=courtesy))
    scene = perceive(vehicles(nobody, ahead, behind), DROPPED)
    assert traffic.following(scene, TABLE_V)[0, 2].item() == pytest.approx(-braking, abs=1e-4)


# The agent that ships


def test_agent_merge_merges_from_the_ramp_sooner_than_mobil():
    table = ganlane.api.evaluate(
        ["agent_merge", "mobil"], ["idm_mobil"], 30, env="merge", goal_m=800.0
    )
    assert table["goal"].to_list() == [30, 30]
    agent, mobil = table["mean_speed_mps"].to_list()
    assert agent > mobil


def test_agent_exit_takes_every_exit_and_is_faster_than_mobil():
    table = ganlane.api.evaluate(["agent_exit", "mobil"], ["idm_mobil"], 30, env="exit")
    assert table["goal"].to_list() == [30, 30]
    agent, mobil = table["mean_speed_mps"].to_list()
    assert agent > mobil


# What is refused


class Cruise(TrafficModule):
    """Drives on, whatever comes."""

    def move(self, vehicles, memory, key, step):
        return vehicles.with_(x=vehicles.x + vehicles.speed * self.dt), memory


def test_traffic_that_does_not_heed_the_ends_of_lanes_is_refused():
    with pytest.raises(UserError, match="Cruise does not heed the ends of lanes"):
        HighwayEnv(Cruise(DROPPED))


def test_recycling_is_refused():
    config = make(EnvConfig, {"name": "merge", "recycle": True})
    with pytest.raises(UserError, match=r"env.recycle=true on a road with lanes that end"):
        make_env(make_traffic(IdmTrafficConfig(), config), DrivingConfig(env=config))


@pytest.mark.parametrize(
    "stretches",
    [
        (LaneStretch(),),
        (LaneStretch(end_m=9.0, end=WALL),) * 2,
        (LaneStretch(end_m=9.0, end=EXIT), LaneStretch(end_m=9.0, end=EXIT), LaneStretch()),
    ],
)
def test_a_road_needs_a_stretch_for_each_lane_one_without_an_end_and_at_most_one_exit(stretches):
    with pytest.raises(UserError, match="expected one for each of"):
        Road(2 if len(stretches) < 3 else 3, stretches=stretches)


@pytest.mark.parametrize(
    ("stretch", "wrong"),
    [
        ({"begin_m": 9.0, "end_m": 9.0, "end": WALL}, "more than"),
        ({"end_m": 9.0}, "wall or exit where the lane has an end"),
        ({"end": WALL}, "nothing where it has none"),
        ({"end_m": 9.0, "end": "cliff"}, "one of nothing, wall, exit"),
    ],
)
def test_an_impossible_stretch_is_refused(stretch, wrong):
    with pytest.raises(ParameterError, match=wrong):
        LaneStretch(**stretch)


# env=merge, lane_drop, exit


def outcomes(config: EnvConfig, driver: str, traffic: object, rows: int = 64) -> dict[str, int]:
    """How so many episodes end."""
    env = make_env(make_traffic(traffic, config), DrivingConfig(env=config), rows)
    policy = make_driver(driver, config).policy
    td = env.reset()
    ended = torch.zeros(rows, dtype=torch.bool)
    counts = dict.fromkeys(keys.END_EVENTS, 0)
    while not ended.all():
        td = env.step(policy(td))["next"]
        fresh = td["done"][:, 0] & ~ended
        for name in counts:
            counts[name] += int((td[keys.EVENTS, name][:, 0] & fresh).sum())
        ended |= fresh
    return {name: count for name, count in counts.items() if count}


@pytest.mark.parametrize("scene", ["merge", "lane_drop", "exit"])
@pytest.mark.parametrize(
    ("driver", "traffic"),
    [("mobil", IdmMobilTrafficConfig()), ("mobil_egoistic", IdmTrafficConfig())],
)
def test_a_mobil_ego_reaches_its_goal(scene, driver, traffic):
    assert outcomes(make(EnvConfig, scene), driver, traffic) == {"goal": 64}


@pytest.mark.parametrize(
    ("scene", "end"), [("merge", "timeout"), ("lane_drop", "timeout"), ("exit", "missed_exit")]
)
def test_an_ego_that_keeps_its_lane_does_not(scene, end):
    """It stands at the end of its lane, or passes the exit."""
    assert outcomes(make(EnvConfig, scene), "keep_lane", IdmTrafficConfig()) == {end: 64}


def test_nobody_is_left_standing_at_a_lane_drop():
    """All of the ending lane have found their way into the others within three minutes."""
    config = replace(make(EnvConfig, "lane_drop"), goal_m=1e5, timeout_s=300.0)
    env = make_env(make_traffic(IdmMobilTrafficConfig(), config), DrivingConfig(env=config), 32)
    policy = make_driver("mobil", config).policy
    td = env.reset()
    for _ in range(180):
        td = env.step(policy(td))["next"]
        assert not td["done"].any()
    assert (td[keys.VEHICLES, "x"] > 500.0).all()
    assert (td[keys.VEHICLES, "speed"] > 10.0).all()


@pytest.mark.parametrize("kernel", ["torch", "native"])
@pytest.mark.parametrize(("lane", "event"), [(0, "goal"), (1, "missed_exit")])
def test_at_the_end_of_the_exit_lane_the_ego_has_left_the_road_or_missed_it(kernel, lane, event):
    exit_lane = LaneStretch(200.0, 400.0, EXIT)
    env = environment(
        lanes=2,
        vehicles=2,
        stretches=(exit_lane, LaneStretch()),
        goal_m=100.0,
        dtype=torch.float32,
        kernel=kernel,
    )
    cars = ({"x": 395.0, "lane": lane}, {"x": -900.0, "lane": 1})
    td = placed(env, vehicles(*cars, dtype=torch.float32))
    after = step(env, td)
    assert [name for name in keys.END_EVENTS if after[keys.EVENTS, name]] == [event]
    assert after["terminated"]
    assert 400.0 <= after[keys.VEHICLES, "x"][0, 0] < 402.5
    earlier = placed(env, vehicles({**cars[0], "x": 360.0}, cars[1], dtype=torch.float32))
    assert not step(env, earlier)["done"]


@pytest.mark.parametrize("scene", ["merge", "on_ramp", "lane_drop", "weave", "exit"])
def test_gymnasium_has_no_complaint(scene):
    env = gymnasium.make("ganlane/Highway-v0", env=scene, observation="road_view", mask="safe")
    check_env(env.unwrapped, skip_render_check=True)
    envs = gymnasium.make_vec("ganlane/Highway-v0", num_envs=3, env=scene)
    observation, _ = envs.reset(seed=1)
    assert envs.observation_space.contains(observation)


# env=on_ramp, weave


@pytest.mark.parametrize("driver", ["mobil", "keep_lane"])
def test_an_ego_beside_an_on_ramp_lets_the_others_merge(driver):
    config = make(EnvConfig, "on_ramp")
    assert outcomes(config, driver, IdmMobilTrafficConfig()) == {"goal": 64}


def test_all_who_come_from_the_ramp_find_their_way_onto_the_road():
    config = replace(make(EnvConfig, "on_ramp"), goal_m=1e5, timeout_s=300.0)
    env = make_env(make_traffic(IdmMobilTrafficConfig(), config), DrivingConfig(env=config), 32)
    policy = make_driver("mobil", config).policy
    td = env.reset()
    assert ((td[keys.VEHICLES, "target_lane"] == 0).sum(1) == 6).all()
    for _ in range(180):
        td = env.step(policy(td))["next"]
        assert not td["done"].any()
    assert (td[keys.VEHICLES, "x"] > 400.0).all()
    assert (td[keys.VEHICLES, "target_lane"] > 0).all()
    assert (td[keys.VEHICLES, "speed"] > 10.0).all()


@pytest.mark.parametrize("traffic", [IdmTrafficConfig(), IdmMobilTrafficConfig()])
def test_where_a_ramp_becomes_an_exit_a_mobil_ego_leaves_the_road_by_it(traffic):
    assert outcomes(make(EnvConfig, "weave"), "mobil", traffic) == {"goal": 64}


def test_where_a_ramp_becomes_an_exit_an_ego_that_keeps_its_lane_misses_it():
    assert outcomes(make(EnvConfig, "weave"), "keep_lane", IdmTrafficConfig()) == {
        "missed_exit": 64
    }


def test_among_generated_drivers_who_make_no_room_an_ego_on_its_way_to_the_exit_is_not_hit():
    """It does not stop for one after the other."""
    assert "hard_crash" not in outcomes(make(EnvConfig, "exit"), "mobil", HumanTrafficConfig())
