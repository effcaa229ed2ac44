"""Rule-driven traffic as a module: keys, memory, and MOBIL once a second."""

from __future__ import annotations

import pytest
import torch
from reference.worlds import DOUBLE, environment, same_bits, step, vehicles

from ganlane import keys
from ganlane.parameters.driving import MobilParameters
from ganlane.sim.state import Road, Vehicles
from ganlane.traffic.base import TrafficModule
from ganlane.traffic.idm_mobil import IdmMobilTraffic, IdmTraffic

ROAD = Road(lanes=2)
EGO = {"x": -1000.0, "lane": 0}
# The second car wants to overtake the third. (With Table IV the third would politely move aside.)
SELFISH = MobilParameters(politeness_rear=0.0, politeness_side=0.0)
CARS = (EGO, {"x": 0.0, "lane": 0, "speed": 20.0}, {"x": 54.5, "lane": 0, "speed": 15.0, "desired_speed": 15.0})


def move(traffic: TrafficModule, scene: Vehicles, step: int | list[int] = 0) -> tuple[Vehicles, dict]:
    rows = scene.x.shape[0]
    steps = torch.as_tensor(step).expand(rows)
    zero = torch.zeros(rows, dtype=torch.int64)
    return traffic.move(scene, traffic.fresh_memory(scene, zero), zero, steps)


def two_rows(scene: Vehicles) -> Vehicles:
    return Vehicles(*(value.repeat(2, 1) for value in scene.as_dict().values()))


def test_mobil_overtakes_and_idm_alone_does_not():
    scene = vehicles(*CARS)
    assert move(IdmMobilTraffic(ROAD, mobil=SELFISH), scene)[0].target_lane.tolist() == [[0, 1, 0]]
    assert move(IdmTraffic(ROAD), scene)[0].target_lane.tolist() == [[0, 0, 0]]


def test_a_polite_slow_driver_moves_aside_for_the_one_behind():
    assert move(IdmMobilTraffic(ROAD), vehicles(*CARS))[0].target_lane.tolist() == [[0, 0, 1]]


@pytest.mark.parametrize("step", [1, 5, 9, 11])
def test_mobil_decides_only_when_a_second_is_full(step):
    assert move(IdmMobilTraffic(ROAD, mobil=SELFISH), vehicles(*CARS), step)[0].target_lane.tolist() == [[0, 0, 0]]
    assert move(IdmMobilTraffic(ROAD, mobil=SELFISH), vehicles(*CARS), 20)[0].target_lane.tolist() == [[0, 1, 0]]


def test_each_row_has_a_clock_of_its_own():
    moved, _ = move(IdmMobilTraffic(ROAD, mobil=SELFISH), two_rows(vehicles(*CARS)), [3, 10])
    assert moved.target_lane[:, 1].tolist() == [0, 1]


def test_an_unspoken_wish_of_the_ego_holds_nobody_back():
    """Traffic sees what the ego does, not what it might want.

    The ego would go left if it were MOBIL's to drive; the third car, 10 m behind it, wants into the same lane.
    """
    slow = {"speed": 15.0, "desired_speed": 15.0}
    ego, ahead = {"x": 0.0, "lane": 0}, {"x": 54.5, "lane": 0, **slow}
    other, ahead_of_it = {"x": -10.0, "lane": 2}, {"x": 44.5, "lane": 2, **slow}
    traffic = IdmMobilTraffic(Road(lanes=3), mobil=SELFISH)
    assert move(traffic, vehicles(ego, ahead, other, ahead_of_it))[0].target_lane[0, 2] == 1


def test_a_car_beside_a_slow_one_overtakes_it_in_the_end():
    traffic, scene = IdmMobilTraffic(ROAD, mobil=SELFISH), vehicles(*CARS)
    memory = traffic.fresh_memory(scene, torch.zeros(1).long())
    for number in range(300):
        scene, memory = traffic.move(scene, memory, torch.zeros(1).long(), torch.tensor([number]))
    assert scene.x[0, 1] > scene.x[0, 2] + 20.0
    assert scene.speed[0, 1] > 20.0


def test_traffic_is_the_same_whatever_the_decision_period_of_the_ego():
    """After 6 s of an ego that keeps its lane."""
    states = []
    for period_s, decisions in ((0.1, 60), (0.5, 12), (2.0, 3)):
        env = environment(num_envs=8, period_s=period_s)
        td = env.reset()
        for _ in range(decisions):
            td = step(env, td)
        states.append(td)
    assert torch.any(states[0][keys.VEHICLES, "target_lane"] != env.reset()[keys.VEHICLES, "target_lane"])
    for other in states[1:]:
        assert (
            same_bits(states[0].select(keys.VEHICLES, keys.TRAFFIC), other.select(keys.VEHICLES, keys.TRAFFIC)) == []
        )


@pytest.mark.parametrize("kind", [IdmTraffic, IdmMobilTraffic])
def test_the_state_at_t_is_never_written(kind):
    env = environment(num_envs=4, traffic=kind(Road(lanes=3)))
    td = env.reset()
    kept = td.clone()
    after = env.traffic(td.clone(recurse=False))
    assert same_bits(td.select(keys.VEHICLES, keys.TRAFFIC), kept.select(keys.VEHICLES, keys.TRAFFIC)) == []
    assert set(after[keys.MOVED].keys()) == set(keys.VEHICLE_FIELDS)
    assert (after[keys.MOVED, "x"] > kept[keys.VEHICLES, "x"]).all()


def test_the_memory_is_as_its_spec_says():
    traffic, scene = IdmMobilTraffic(ROAD), vehicles(*CARS)
    memory = traffic.init_memory(scene, torch.zeros(1).long())
    spec = traffic.memory_spec(1, 3, DOUBLE)
    assert {name: (tuple(value.shape), value.dtype) for name, value in memory.items()} == spec
    assert spec == {"steering": ((1, 3), DOUBLE)}


def test_everybody_reacts_to_the_state_at_t_and_to_nothing_later():
    """The leader brakes hard in this step; its follower's acceleration does not know yet."""
    leader = {"x": 50.0, "lane": 0, "speed": 20.0}
    calm, braking = vehicles(EGO, {"x": 0.0, "lane": 0}, leader), vehicles(EGO, {"x": 0.0, "lane": 0}, leader, wall())
    followers = [move(IdmTraffic(ROAD), scene)[0] for scene in (calm, braking)]
    assert followers[1].acceleration[0, 2] < -5.0
    assert followers[0].acceleration[0, 1] == followers[1].acceleration[0, 1]


def wall() -> dict:
    return {"x": 65.0, "lane": 0, "speed": 0.0}
