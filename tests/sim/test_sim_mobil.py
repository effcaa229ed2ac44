"""MOBIL against values worked by hand, one vehicle per gap, and its promise.

Nobody is made to brake harder than ``b_safe``, nor later while the one ahead does not brake. What
holds exactly: whoever stands in the lane when the decision falls, signals into it, or enters it in
the same second, is asked for no more than ``b_safe`` by the vehicle that enters, then or later. The
promise does not cover one whom nobody sees coming, an ego that is not ``signalled``.
"""

from dataclasses import replace

import pytest
import torch
from reference.worlds import DOUBLE, drawing, moves, random_scenes, vehicles, vehicles_at

from ganlane.settings.driving import MobilParameters, Visibility
from ganlane.sim import mobil as mobil_module
from ganlane.sim.idm import TABLE_V, idm_acceleration
from ganlane.sim.mobil import (
    TABLE_IV,
    lane_accelerations,
    mobil_changes,
    mobil_criterion,
    mobil_wishes,
    without_ego,
)
from ganlane.sim.neighbours import FREE_GAP_M, perceive
from ganlane.sim.state import Road
from ganlane.traffic.idm_mobil import IdmTraffic

B_SAFE = TABLE_IV.safe_deceleration
SELFISH = replace(TABLE_IV, politeness_rear=0.0, politeness_side=0.0)

# The subject drives 20 m/s and would like 25; 50 m ahead (bumper to bumper) somebody drives 15 m/s.
SUBJECT = {"x": 0.0, "lane": 0, "speed": 20.0, "desired_speed": 25.0}
SLOW = {"x": 54.5, "lane": 0, "speed": 15.0, "desired_speed": 15.0}


def wish(*cars, mobil=TABLE_IV):
    """Of the first car."""
    road = Road(lanes=2)
    return mobil_wishes(perceive(vehicles(*cars), road), mobil=mobil)[0, 0].item()


def incentive_to_the_left(*cars):
    """For the first car, to change from lane 0 to lane 1."""
    scene = perceive(vehicles(*cars), Road(lanes=2))
    lanes = torch.tensor([0.0, 1.0]).expand(1, len(cars), 2)
    both = lane_accelerations(scene, lanes, TABLE_V)
    incentive, _ = mobil_criterion(both.of(slice(1, 2)), both.of(slice(0, 1)), TABLE_IV)
    return incentive[0, 0, 0].item()


def fast_follower(gap):
    """On the other lane, at its desired speed of 25 m/s."""
    return {"x": -4.5 - gap, "lane": 1, "speed": 25.0, "desired_speed": 25.0}


def test_an_empty_lane_beside_a_slow_leader_is_worth_the_gain_in_acceleration():
    """IDM (test_sim_idm): 0.413272 m/s2 on an empty lane, -1.371332 m/s2 behind the slow one."""
    assert incentive_to_the_left(SUBJECT, SLOW) == pytest.approx(1.784604, abs=1e-5)
    assert wish(SUBJECT, SLOW) == 1


def test_the_incentive_weighs_both_followers():
    """Worked by hand, with the new follower 60 m behind and the old one 30 m behind.

    New follower behind the subject: s* = 2 + 40 + 25 * 5 / 2.181742 = 99.293656,
    -0.7 (99.293656 / 60)^2 = -1.917073; without it -0.7 (42 / 10000)^2 = -0.000012: burden
    -1.917060. Old follower, 20 m/s, behind the subject: 0.7 (0.5904 - (34 / 30)^2) = -0.485831;
    behind the slow one, gap 30 + 4.5 + 50 = 84.5 m: 0.7 (0.5904 - (79.834925 / 84.5)^2) =
    -0.211563: relief 0.274268. Incentive: 1.784604 + 1.0 * -1.917060 + 0.5 * 0.274268 = 0.004678.
    """
    old = {"x": -34.5, "lane": 0, "speed": 20.0, "desired_speed": 25.0}
    cars = (SUBJECT, SLOW, fast_follower(60.0), old)
    assert incentive_to_the_left(*cars) == pytest.approx(0.004678, abs=1e-5)
    # 0.0047 is under the threshold of 0.1, over one of 0, and under it again without the old
    # follower's relief.
    assert wish(*cars) == 0
    assert wish(*cars, mobil=MobilParameters(threshold=0.0)) == 1
    assert wish(*cars[:3], mobil=MobilParameters(threshold=0.0)) == 0
    assert wish(*cars, mobil=MobilParameters(politeness_side=0.0)) == 1


def test_nobody_changes_in_front_of_somebody_who_would_have_to_brake_too_hard():
    """-0.7 (99.293656 / gap)^2 = -4 at a gap of 41.537 m."""
    assert wish(SUBJECT, SLOW, fast_follower(41.6), mobil=SELFISH) == 1
    assert wish(SUBJECT, SLOW, fast_follower(41.5), mobil=SELFISH) == 0


# The promise, at the decision


def new_demands(before, change):
    """What every driver is asked for by one that has just decided to enter a lane it attends to,
    [N, M, M] (i by j).

    m/s2, and whether j is i's leader there; nearest of those who are seen in the lane after all
    decisions.
    """
    scene = perceive(before.with_(target_lane=before.target_lane + change), ROAD)
    entered = scene.vehicles.target_lane.to(DOUBLE)[:, None, :]
    attends = (scene.attention.low[:, :, None] <= entered) & (
        entered <= scene.attention.high[:, :, None]
    )
    leads = torch.zeros_like(attends)
    for lane in range(3):
        here = (scene.presence.low <= lane) & (lane <= scene.presence.high)
        gap = torch.where(here[:, None, :], scene.pairs.ahead, FREE_GAP_M)
        nearest = (gap == gap.amin(-1, keepdim=True)) & (gap < FREE_GAP_M)
        leads |= nearest & (entered == lane)
    asked = idm_acceleration(
        before.speed[:, :, None],
        before.desired_speed[:, :, None],
        scene.pairs.ahead,
        before.speed[:, None, :],
    )
    return asked, leads & attends & (change != 0)[:, None, :]


ROAD = Road(lanes=3)


@pytest.fixture(scope="module")
def crowd():
    return random_scenes(rows=6000, cars=12, lanes=3, seed=1)


@pytest.mark.parametrize("mobil", [TABLE_IV, SELFISH], ids=["polite", "selfish"])
def test_nobody_is_asked_for_more_not_even_one_who_enters_the_same_lane_in_the_same_second(
    mobil, crowd
):
    change = mobil_changes(perceive(crowd, ROAD), mobil=mobil)
    asked, leads = new_demands(crowd, change)
    assert (asked[leads] >= -B_SAFE - 1e-9).all()
    # Not for want of cases: thousands of new followers, hundreds near the limit, and pairs in one
    # lane in one second.
    stays = leads & (change == 0)[:, :, None]
    assert stays.sum() > 3000
    assert (asked[stays] < -0.75 * B_SAFE).sum() > 100
    assert (leads & (change != 0)[:, :, None]).sum() > 100


def test_without_a_look_at_what_they_would_ask_of_each_other_hundreds_would_be_asked_for_more(
    crowd, monkeypatch
):
    """So the test above can fail: with the 60 m alone both go, however fast the rear one is."""
    scene = perceive(crowd, ROAD)
    wish = without_ego(mobil_wishes(scene))
    monkeypatch.setattr(mobil_module, "idm_acceleration", lambda speed, *_: torch.zeros_like(speed))
    change = mobil_module.one_at_a_time(scene, wish)
    asked, leads = new_demands(crowd, change)
    hard = leads & (asked < -B_SAFE - 1e-9)
    # The figures of docs/simulator.md.
    assert (change != 0).sum() == 13_217
    assert hard.sum() == 608
    assert asked[hard].min() == TABLE_V.min_acceleration
    row, behind, ahead = hard.nonzero().T
    assert (change[row, behind] != 0).all()
    assert (crowd.x[row, ahead] - crowd.x[row, behind] >= TABLE_IV.exclusive_m).all()


def test_an_ego_that_is_seen_by_its_body_alone_can_be_asked_for_more():
    """It signals nothing: the other one enters the lane in front of it as if it were not coming."""
    ego = {"x": 0.0, "y": 0.0, "target_lane": 1, "speed": 30.0, "desired_speed": 30.0}
    enters = {"x": 30.0, "lane": 2, "speed": 10.0}
    slow = {"x": 45.0, "lane": 2, "speed": 2.0}
    for seen, goes in ((Visibility.BODY, -1), (Visibility.SIGNALLED, 0)):
        scene = vehicles({**ego, "visibility": int(seen)}, enters, slow)
        assert mobil_changes(perceive(scene, ROAD), mobil=SELFISH)[0, 1] == goes


# Afterwards

# Columns: the ego is 0, a slow car 2.
ENTERS = 1
FOLLOWS = 3


def merges(rows):
    """Scenes in which one has just decided to enter the lane of another, whatever their speeds and
    distances.

    The ego is far away; a slow car makes the one in front of it want the other lane.
    """
    between = drawing((rows,), 2)
    x = torch.stack(
        (between(5000, 5001), between(0, 0), between(7.5, 85), between(-125, -5)), dim=1
    )
    speed = torch.stack((between(20, 21), between(0, 30), between(0, 25), between(0, 35)), dim=1)
    desired = torch.maximum(torch.stack([between(10, 40) for _ in range(4)], dim=1), 0.8 * speed)
    lane = torch.tensor([0, 0, 0, 1]).expand(rows, -1)
    scene = vehicles_at(x, lane, speed=speed, desired_speed=desired)
    road = Road(lanes=2)
    change = mobil_changes(perceive(scene, road), mobil=SELFISH)
    scene = scene.with_(target_lane=lane + change * (torch.arange(4) == ENTERS))
    return scene.part(change[:, ENTERS] == 1)


def demand(scene):
    """What the one that enters asks of its new follower, m/s2, [N]."""
    enters, follows = scene.columns(ENTERS), scene.columns(FOLLOWS)
    gap = enters.x - follows.x - 4.5
    return idm_acceleration(follows.speed, follows.desired_speed, gap, enters.speed)


def demands(scene):
    """:func:`demand` at every step of 8 s, in which the one that enters drives like everybody else
    but never brakes, [steps, N].
    """

    def drives(before, after):
        no_slower = torch.maximum(after.speed, before.speed)
        return after.with_(speed=torch.where(torch.arange(4) == ENTERS, no_slower, after.speed))

    film = moves(IdmTraffic(Road(lanes=2)), scene, 80, drives)
    return torch.stack([demand(scene), *map(demand, film)])


def test_nor_is_the_new_follower_asked_for_more_than_b_safe_while_the_one_ahead_does_not_brake():
    """IDM calms down by itself: a demand may grow to the comfortable deceleration.

    What is above that shrinks.
    """
    film = demands(merges(rows=12_000))
    assert film.shape[1] > 3000
    assert film.min() >= -B_SAFE
    assert (film >= film[0].clamp_max(-TABLE_V.comfortable_deceleration) - 1e-9).all()
    hard = film[0] < -0.75 * B_SAFE
    assert hard.sum() > 60
    assert (film[1:, hard] > film[0, hard]).all()
