"""Roads whose lanes begin and end: what drivers do there, and what the ego may."""

import pytest
import torch
from entry_own_parts import Cruise
from reference.refusals import user_error
from reference.worlds import moves, placed, step, vehicles
from tensordict import TensorDictBase

import ganlane
from ganlane import keys
from ganlane.agents.drivers import MobilDriver
from ganlane.env import HighwayEnv
from ganlane.evaluation.measures import ego_at_fault
from ganlane.settings.driving import MobilParameters
from ganlane.settings.road import EXIT, WALL, LaneStretch, Stretches
from ganlane.sim.dynamics import ego_scene
from ganlane.sim.idm import TABLE_V
from ganlane.sim.lane_ends import ways_out
from ganlane.sim.mobil import TABLE_IV, letting_past
from ganlane.sim.state import Road
from ganlane.traffic.idm_mobil import IdmMobilTraffic, IdmTraffic
from ganlane.transforms import ActionMaskTransform

#: The right lane of two ends 400 m ahead.
DROP: Stretches = (LaneStretch(end_m=400.0, end=WALL), LaneStretch())
DROPPED = Road(2, stretches=DROP)
#: Beside a car that begins 200 m ahead.
LATE = Road(2, stretches=(LaneStretch(200.0, 400.0, WALL), LaneStretch()))
#: Half a car's length.
HALF_M = 2.25
#: Far behind, where it is as good as nobody.
BEHIND = {"x": -900.0, "lane": 1}


# Who drives towards the end of a lane


def test_a_driver_that_keeps_its_lane_stops_some_17_metres_before_its_end():
    """IDM's gap of 2 m to a standing car, and 15 m to turn out; from four speeds."""
    cars = vehicles({"x": 0.0, "desired_speed": 36.0}, BEHIND).part([0] * 4)
    cars.speed[:, 0] = torch.tensor([5.0, 15.0, 25.0, 35.0])
    *_, last = moves(IdmTraffic(DROPPED), cars, 1500)
    assert (400.0 - last.x[:, 0] - HALF_M).tolist() == pytest.approx([17.0] * 4, abs=0.5)
    assert (last.speed[:, 0] < 0.1).all()


def test_a_car_that_stands_at_the_end_turns_out_as_soon_as_the_lane_is_free():
    """Its body is out of the lane before its front is at the wall."""
    cars = vehicles(BEHIND, {"x": 400.0 - 17.0 - HALF_M, "speed": 0.0})
    for now in moves(IdmMobilTraffic(DROPPED), cars, 300):
        beside_the_wall = now.x[0, 1] + HALF_M > 400.0
        assert not beside_the_wall or now.y[0, 1] > 2.0 + 1.25 - 0.1
    assert now.x[0, 1] > 430.0


# The ego


@pytest.mark.parametrize(
    ("form", "road", "ego", "expected"),
    [
        *((form, LATE, {"x": 0.0}, [True, False, False]) for form in ("legal", "safe")),
        *((form, LATE, {"x": 210.0}, [True, True, False]) for form in ("legal", "safe")),
        # A wall is a standing car: at 25 m/s, 60 m before it, one has to brake with 5.2 m/s2.
        ("safe", DROPPED, {"x": 340.0, "lane": 1, "speed": 25.0}, [True, False, False]),
        ("safe", DROPPED, {"x": 0.0, "lane": 1, "speed": 25.0}, [True, False, True]),
    ],
)
def test_the_mask_knows_where_lanes_are_and_a_safe_one_how_far_they_go_on(
    form, road, ego, expected
):
    mask = ActionMaskTransform(road, form, idm=TABLE_V)
    cars = vehicles({"speed": 10.0, **ego}, BEHIND)
    allowed, _ = mask.allowed(cars, torch.zeros(1, dtype=torch.int64), road)
    assert allowed[0].tolist() == expected


@pytest.mark.parametrize(("lane", "at_fault"), [(0, True), (1, False)])
def test_who_drives_into_a_wall_is_at_fault(lane, at_fault):
    cars = vehicles({"x": 399.0, "lane": lane}, BEHIND)
    assert bool(ego_at_fault(cars, DROPPED)) == at_fault


# Who has to change its lane


#: The right lane of two leaves the road 400 m ahead.
LEAVING: Stretches = (LaneStretch(end_m=400.0, end=EXIT), LaneStretch())


def end_beside(
    ahead_m: float, courtesy: float = 2.0, mirrored: bool = False, kernel: str = "torch"
) -> TensorDictBase:
    """How the ego ends that has to take the exit, beside a car as fast that makes no room.

    The car is so far ahead in the lane of the exit.
    """
    stretches = LEAVING[::-1] if mirrored else LEAVING
    env = HighwayEnv(
        IdmTraffic(Road(2, stretches=stretches)),
        vehicles=2,
        kernel=kernel,
        mobil=MobilParameters(courtesy=courtesy),
    )
    ego = {"x": 0.0, "lane": int(not mirrored), "speed": 20.0, "desired_speed": 20.0}
    other = {**ego, "x": ahead_m, "lane": int(mirrored)}
    driver = MobilDriver(env.road)
    td = placed(env, vehicles(ego, other, dtype=torch.float32))
    while not td["done"].any():
        td = step(env, td, driver(td)["action"])
    return td


@pytest.mark.parametrize(("courtesy", "end"), [(2.0, "goal"), (0.0, "missed_exit")])
@pytest.mark.parametrize("kernel", ["torch", "native"])
def test_an_ego_beside_a_car_as_fast_as_it_falls_behind_and_takes_the_exit(courtesy, end, kernel):
    assert end_beside(1.0, courtesy, kernel=kernel)[keys.EVENTS, end]


@pytest.mark.parametrize("behind_m", [1.0, 5.0, 12.0])
@pytest.mark.parametrize("mirrored", [False, True])
def test_an_ego_just_ahead_of_a_car_as_fast_that_makes_no_room_lets_it_past_and_takes_the_exit(
    behind_m, mirrored
):
    td = end_beside(-behind_m, mirrored=mirrored)
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


# The agent that ships


@pytest.mark.parametrize(("scene", "goal_m"), [("merge", 800.0), ("exit", 1000.0)])
def test_an_agent_merges_or_takes_the_exit_always_and_is_faster_than_mobil(scene, goal_m):
    drivers = [f"agent_{scene}", "mobil"]
    table = ganlane.api.evaluate(drivers, ["idm_mobil"], 30, env=scene, goal_m=goal_m)
    assert table["goal"].to_list() == [30, 30]
    agent, mobil = table["mean_speed_mps"]
    assert agent > mobil


# What is refused


def test_traffic_that_does_not_heed_the_ends_of_lanes_is_refused():
    with user_error("Cruise does not heed the ends of lanes"):
        HighwayEnv(Cruise(DROPPED, 0))


def test_recycling_is_refused():
    with user_error("env.recycle=true on a road with lanes that end"):
        ganlane.make_env("idm", env="merge", recycle=True)


@pytest.mark.parametrize(
    ("lanes", "stretches"),
    [
        (2, (LaneStretch(),)),
        (2, (LaneStretch(end_m=9.0, end=WALL),) * 2),
        (3, (*(LaneStretch(end_m=9.0, end=EXIT),) * 2, LaneStretch())),
    ],
)
def test_a_road_needs_a_stretch_for_each_lane_one_without_an_end_and_at_most_one_exit(
    lanes, stretches
):
    with user_error("expected one for each of"):
        Road(lanes, stretches=stretches)


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
    with user_error(wrong):
        LaneStretch(**stretch)


# The scenarios


def outcomes(scene: str, driver: str, traffic: str) -> dict[str, int]:
    """How 64 episodes end."""
    (row,) = ganlane.api.evaluate([driver], [traffic], 64, env=scene).to_dicts()
    return {name: row[name] for name in keys.END_EVENTS if row[name]}


@pytest.mark.parametrize(
    ("driver", "traffic"), [("mobil", "idm_mobil"), ("mobil", "idm"), ("mobil_egoistic", "idm")]
)
@pytest.mark.parametrize("scene", ["merge", "lane_drop", "exit", "weave"])
def test_a_mobil_ego_reaches_its_goal(scene, driver, traffic):
    assert outcomes(scene, driver, traffic) == {"goal": 64}


@pytest.mark.parametrize(
    ("scene", "end"),
    [
        ("merge", "timeout"),
        ("lane_drop", "timeout"),
        ("exit", "missed_exit"),
        ("weave", "missed_exit"),
    ],
)
def test_an_ego_that_keeps_its_lane_does_not(scene, end):
    """It stands at the end of its lane, or passes the exit."""
    assert outcomes(scene, "keep_lane", "idm") == {end: 64}


@pytest.mark.parametrize("driver", ["mobil", "keep_lane"])
def test_an_ego_beside_an_on_ramp_lets_the_others_merge(driver):
    assert outcomes("on_ramp", driver, "idm_mobil") == {"goal": 64}


@pytest.mark.parametrize(
    ("scene", "ending", "cars", "end_m"), [("lane_drop", 2, 7, 500.0), ("on_ramp", 0, 6, 400.0)]
)
def test_nobody_is_left_standing_where_a_lane_ends(scene, ending, cars, end_m):
    """All of the ending lane have found their way into the others within three minutes."""
    env = ganlane.make_env("idm_mobil", 32, env=scene, goal_m=1e5, timeout_s=300.0)
    driver = MobilDriver(env.base_env.road)
    td = env.reset()
    assert ((td[keys.VEHICLES, "target_lane"] == ending).sum(1) == cars).all()
    for _ in range(180):
        td = env.step(driver(td))["next"]
        assert not td["done"].any()
    assert (td[keys.VEHICLES, "x"] > end_m).all()
    assert (td[keys.VEHICLES, "target_lane"] != ending).all()
    assert (td[keys.VEHICLES, "speed"] > 10.0).all()


def test_among_generated_drivers_who_make_no_room_an_ego_on_its_way_to_the_exit_is_not_hit():
    """It does not stop for one after the other."""
    assert "hard_crash" not in outcomes("exit", "mobil", "human")
