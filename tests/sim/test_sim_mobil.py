"""MOBIL against values worked by hand, and one vehicle per gap."""

from __future__ import annotations

import pytest
import torch
from reference import scalar
from reference.worlds import environment, rules_of, scalar_state, vehicles

from ganlane.sim.idm import TABLE_V
from ganlane.sim.mobil import (
    TABLE_IV,
    Change,
    MobilParameters,
    lane_accelerations,
    mobil_changes,
    mobil_criterion,
    mobil_wishes,
    safe_change,
)
from ganlane.sim.neighbours import perceive
from ganlane.sim.state import Road, Vehicles

# The subject drives 20 m/s and would like 25; 50 m ahead (bumper to bumper) somebody drives 15 m/s.
SUBJECT = {"x": 0.0, "lane": 0, "speed": 20.0, "desired_speed": 25.0}
SLOW = {"x": 54.5, "lane": 0, "speed": 15.0, "desired_speed": 15.0}
OWN = -1.371332  # IDM behind the slow one (test_sim_idm)
FREE = 0.413272  # IDM on an empty lane


def wish(*cars, lanes: int = 2, mobil: MobilParameters = TABLE_IV) -> int:
    """Of the first car."""
    road = Road(lanes=lanes)
    return mobil_wishes(perceive(vehicles(*cars), road), road, mobil=mobil)[0, 0].item()


def change_to_the_left(scene) -> Change:
    """Of the first car, from lane 0 to lane 1."""
    lanes = torch.tensor([0.0, 1.0]).expand(*scene.vehicles.x.shape, 2)
    both = lane_accelerations(scene, lanes, TABLE_V)
    assert both.own[0, 0, 0].item() == pytest.approx(OWN, abs=1e-5)
    return Change(
        *(number[..., 0] for number in mobil_criterion(both.of(slice(1, 2)), both.of(slice(0, 1)), TABLE_IV))
    )


def fast_follower(gap: float) -> dict:
    """On the other lane, at its desired speed of 25 m/s."""
    return {"x": -4.5 - gap, "lane": 1, "speed": 25.0, "desired_speed": 25.0}


def test_an_empty_lane_beside_a_slow_leader_is_worth_the_gain_in_acceleration():
    scene = perceive(vehicles(SUBJECT, SLOW), Road(lanes=2))
    change = change_to_the_left(scene)
    assert change.incentive[0, 0].item() == pytest.approx(FREE - OWN, abs=1e-5)  # 1.784604
    assert change.safe[0, 0]
    assert wish(SUBJECT, SLOW) == 1


def test_the_incentive_weighs_both_followers():
    """Worked by hand, with the new follower 60 m behind and the old one 30 m behind.

    New follower behind the subject: s* = 2 + 40 + 25 * 5 / 2.181742 = 99.293656,
    -0.7 (99.293656 / 60)^2 = -1.917073; without it -0.7 (42 / 10000)^2 = -0.000012: burden -1.917060.
    Old follower, 20 m/s, behind the subject: 0.7 (0.5904 - (34 / 30)^2) = -0.485831; behind the slow one, gap
    30 + 4.5 + 50 = 84.5 m: 0.7 (0.5904 - (79.834925 / 84.5)^2) = -0.211563: relief 0.274268.
    Incentive: 1.784604 + 1.0 * -1.917060 + 0.5 * 0.274268 = 0.004678.
    """
    old = {"x": -34.5, "lane": 0, "speed": 20.0, "desired_speed": 25.0}
    cars = (SUBJECT, SLOW, fast_follower(60.0), old)
    scene = perceive(vehicles(*cars), Road(lanes=2))
    change = change_to_the_left(scene)
    assert change.incentive[0, 0].item() == pytest.approx(0.004678, abs=1e-5)
    # 0.0047 is under the threshold of 0.1, over one of 0, and under it again without the old follower's relief.
    assert wish(*cars) == 0
    assert wish(*cars, mobil=MobilParameters(threshold=0.0)) == 1
    assert wish(*cars[:3], mobil=MobilParameters(threshold=0.0)) == 0
    assert wish(*cars, mobil=MobilParameters(politeness_side=0.0)) == 1


def test_nobody_changes_in_front_of_somebody_who_would_have_to_brake_too_hard():
    """-0.7 (99.293656 / gap)^2 = -4 at a gap of 41.537 m."""
    selfish = MobilParameters(politeness_rear=0.0, politeness_side=0.0)
    assert wish(SUBJECT, SLOW, fast_follower(41.6), mobil=selfish) == 1
    assert wish(SUBJECT, SLOW, fast_follower(41.5), mobil=selfish) == 0


def test_nobody_changes_where_it_would_have_to_brake_too_hard_itself():
    """Own lane blocked at 15 m, the other by a standing car: better by far, and still not safe."""
    wall = {"x": 19.5, "lane": 0, "speed": 0.0}
    other = {"x": 64.5, "lane": 1, "speed": 0.0}
    scene = perceive(vehicles(SUBJECT, wall, other), Road(lanes=2))
    assert not safe_change(scene, torch.ones_like(scene.vehicles.x))[0, 0]
    assert wish(SUBJECT, wall, other) == 0


def test_nobody_changes_into_a_car_alongside_or_off_the_road():
    assert wish(SUBJECT, SLOW, {"x": 2.0, "lane": 1}) == 0
    assert wish(SUBJECT, SLOW, {"x": -2.0, "lane": 1}) == 0
    assert wish(SUBJECT, SLOW, lanes=1) == 0


def test_of_two_lanes_that_pay_the_better_is_taken_and_the_left_one_at_a_tie():
    middle, slow = {**SUBJECT, "lane": 1}, {**SLOW, "lane": 1}
    assert wish(middle, slow, lanes=3) == 1
    assert wish(middle, slow, {"x": 90.0, "lane": 2, "speed": 18.0}, lanes=3) == -1


def test_in_the_middle_of_a_change_nobody_wishes_for_another():
    assert wish({**SUBJECT, "y": 0.29}, SLOW) == 1
    assert wish({**SUBJECT, "y": 0.31}, SLOW) == 0


def test_a_signalled_change_keeps_others_out_of_the_gap_and_one_seen_by_its_body_does_not():
    coming = {"x": 3.0, "y": 8.0, "target_lane": 1}
    middle, slow = {**SUBJECT, "lane": 0}, SLOW
    assert wish(middle, slow, {**coming, "visibility": 2}, lanes=3) == 0
    assert wish(middle, slow, {**coming, "visibility": 1}, lanes=3) == 1


# One vehicle per gap. The ego (index 0) stands far away.

FAR_EGO = {"x": 5000.0, "lane": 0, "speed": 25.0}


def changes(*cars) -> list[int]:
    """Of selfish drivers (a polite slow one would move aside) on three lanes."""
    road, selfish = Road(lanes=3), MobilParameters(politeness_rear=0.0, politeness_side=0.0)
    return mobil_changes(perceive(vehicles(*cars), road), road, mobil=selfish)[0].tolist()


def pair(distance: float) -> list[dict]:
    """Two who both want the empty lane 1, from lanes 0 and 2, the second ``distance`` behind."""
    cars = []
    for x, lane in ((0.0, 0), (-distance, 2)):
        cars += [{**SUBJECT, "x": x, "lane": lane}, {**SLOW, "x": x + 54.5, "lane": lane}]
    return cars


def test_of_two_who_want_the_same_gap_the_foremost_goes():
    assert changes(FAR_EGO, *pair(10.0)) == [0, 1, 0, 0, 0]


def test_farther_than_60_m_apart_both_go():
    assert changes(FAR_EGO, *pair(59.0)) == [0, 1, 0, 0, 0]
    assert changes(FAR_EGO, *pair(61.0)) == [0, 1, 0, -1, 0]


def test_at_its_decision_mobil_never_asks_more_than_the_safe_deceleration_of_the_new_follower():
    env = environment(lanes=3, num_envs=256, vehicles=20, seed=5)
    scene = Vehicles.of(env.reset()["vehicles"])
    made = mobil_changes(perceive(scene, env.road), env.road)
    td = env.reset()
    asked = 0
    for row, car in made.nonzero().tolist():
        view = scalar.View(scalar_state(td, row).cars, rules_of(env))
        lane = view.cars[car].target_lane + made[row, car].item()
        behind = view.follower(car, lane)
        if behind is not None:
            asked += 1
            assert view.acceleration(behind, car) >= -TABLE_IV.safe_deceleration - 1e-9
    assert asked > 100
