"""MOBIL's promise: nobody is made to brake harder than ``b_safe``, nor later while the one ahead does not brake.

What holds exactly: whoever stands in the lane when the decision falls, signals into it, or enters it in the same
second, is asked for no more than ``b_safe`` by the vehicle that enters, then or later. The promise does not cover one
whom nobody sees coming, an ego that is not ``signalled``.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import scalar
from reference.worlds import DOUBLE, vehicles

from ganlane import keys
from ganlane.parameters.driving import MobilParameters, Visibility
from ganlane.sim import mobil as mobil_module
from ganlane.sim.idm import TABLE_V, idm_acceleration
from ganlane.sim.mobil import TABLE_IV, mobil_changes, mobil_wishes, without_ego
from ganlane.sim.neighbours import FREE_GAP_M, perceive
from ganlane.sim.state import Road, Vehicles
from ganlane.traffic.idm_mobil import IdmTraffic

B_SAFE = TABLE_IV.safe_deceleration
SELFISH = replace(TABLE_IV, politeness_rear=0.0, politeness_side=0.0)

# At the decision


def random_scenes(rows: int, cars: int, lanes: int, seed: int) -> Vehicles:
    """On 400 m, at 0 to 35 m/s, one in five in the middle of a change, all of them signalled."""
    generator = torch.Generator().manual_seed(seed)

    def between(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand((rows, cars), generator=generator, dtype=DOUBLE)

    lane = between(0, lanes).long()
    side = (between(0, 2).long() * 2 - 1) * (between(0, 1) < 0.2)
    target = (lane + side).clamp(0, lanes - 1)
    speed, zero = between(0, 35), torch.zeros((rows, cars), dtype=DOUBLE)
    return Vehicles(
        x=between(0, 400),
        y=4.0 * (lane + (target - lane) * between(0, 1)),
        heading=zero,
        speed=speed,
        acceleration=zero,
        length=zero + 4.5,
        width=zero + 2.5,
        desired_speed=torch.maximum(between(10, 40), 0.9 * speed),
        target_lane=target,
        visibility=torch.full_like(lane, int(Visibility.SIGNALLED)),
        valid=lane >= 0,
    )


@settings(max_examples=80)
@given(
    seed=st.integers(0, 2**31),
    lanes=st.integers(2, 6),
    cars=st.integers(3, 20),
    mobil=st.sampled_from([TABLE_IV, SELFISH]),
)
def test_at_its_decision_mobil_asks_no_more_than_b_safe_of_the_new_follower(seed, lanes, cars, mobil):
    """Against the scalar simulator's idea of who the new follower is and what it is asked for; seen in any way."""
    road, scene = Road(lanes), random_scenes(20, cars, lanes, seed)
    generator = torch.Generator().manual_seed(seed)
    scene = scene.with_(
        visibility=torch.randint(0, 3, scene.x.shape, generator=generator),
        valid=torch.rand(scene.x.shape, generator=generator) < 0.9,
    )
    change = mobil_changes(perceive(scene, road), road, mobil=mobil)
    for row, car in change.nonzero().tolist():
        view = view_of(scene, row, lanes)
        lane = view.cars[car].target_lane + change[row, car].item()
        follower = view.follower(car, lane)
        assert follower is None or view.acceleration(follower, car) >= -B_SAFE - 1e-9
        assert view.acceleration(car, view.leader(car, lane)) >= -B_SAFE - 1e-9


def view_of(scene: Vehicles, row: int, lanes: int) -> scalar.View:
    fields = {name: value[row].tolist() for name, value in scene.as_dict().items()}
    cars = [scalar.Car(**{name: value[i] for name, value in fields.items()}) for i in range(len(fields["x"]))]
    return scalar.View(cars, scalar.Rules(lanes=lanes))


def new_demands(before: Vehicles, change: torch.Tensor, road: Road) -> tuple[torch.Tensor, torch.Tensor]:
    """What every driver is asked for by one that has just decided to enter a lane it attends to, [N, M, M] (i by j).

    m/s2, and whether j is i's leader there; nearest of those who are seen in the lane after all decisions.
    """
    scene = perceive(before.with_(target_lane=before.target_lane + change), road)
    entered = scene.vehicles.target_lane.to(DOUBLE)[:, None, :]
    attends = (scene.attention.low[:, :, None] <= entered) & (entered <= scene.attention.high[:, :, None])
    leads = torch.zeros_like(attends)
    for lane in range(road.lanes):
        here = (scene.presence.low <= lane) & (lane <= scene.presence.high)
        gap = torch.where(here[:, None, :], scene.pairs.ahead, FREE_GAP_M)
        nearest = (gap == gap.amin(-1, keepdim=True)) & (gap < FREE_GAP_M)
        leads |= nearest & (entered == lane)
    asked = idm_acceleration(
        before.speed[:, :, None], before.desired_speed[:, :, None], scene.pairs.ahead, before.speed[:, None, :]
    )
    return asked, leads & attends & (change != 0)[:, None, :]


@pytest.mark.parametrize("mobil", [TABLE_IV, SELFISH], ids=["polite", "selfish"])
def test_nobody_is_asked_for_more_not_even_one_who_enters_the_same_lane_in_the_same_second(mobil):
    road = Road(lanes=3)
    scene = random_scenes(rows=6000, cars=12, lanes=3, seed=1)
    change = mobil_changes(perceive(scene, road), road, mobil=mobil)
    asked, leads = new_demands(scene, change, road)
    assert (asked[leads] >= -B_SAFE - 1e-9).all()
    # Not for want of cases: thousands of new followers, hundreds near the limit, and pairs in one lane in one second.
    stays = leads & (change == 0)[:, :, None]
    assert stays.sum() > 3000
    assert (asked[stays] < -0.75 * B_SAFE).sum() > 100
    assert (leads & (change != 0)[:, :, None]).sum() > 100


def test_without_a_look_at_what_they_would_ask_of_each_other_hundreds_would_be_asked_for_more(monkeypatch):
    """So the test above can fail: with the 60 m alone both go, however fast the rear one is."""
    road, vehicles_there = Road(lanes=3), random_scenes(rows=6000, cars=12, lanes=3, seed=1)
    scene = perceive(vehicles_there, road)
    wish = without_ego(mobil_wishes(scene, road))
    monkeypatch.setattr(mobil_module, "idm_acceleration", lambda speed, *_: torch.zeros_like(speed))
    change = mobil_module.one_at_a_time(scene, wish)
    asked, leads = new_demands(vehicles_there, change, road)
    hard = leads & (asked < -B_SAFE - 1e-9)
    # The figures of docs/simulator.md.
    assert (change != 0).sum() == 13_217
    assert hard.sum() == 608
    assert asked[hard].min() == TABLE_V.min_acceleration
    row, behind, ahead = hard.nonzero().T
    assert (change[row, behind] != 0).all()
    assert (vehicles_there.x[row, ahead] - vehicles_there.x[row, behind] >= TABLE_IV.exclusive_m).all()


def test_an_ego_that_is_seen_by_its_body_alone_can_be_asked_for_more():
    """It signals nothing: the other one enters the lane in front of it as if it were not coming."""
    ego = {"x": 0.0, "y": 0.0, "target_lane": 1, "speed": 30.0, "desired_speed": 30.0}
    enters = {"x": 30.0, "lane": 2, "speed": 10.0}
    slow = {"x": 45.0, "lane": 2, "speed": 2.0}
    road = Road(lanes=3)
    for seen, goes in ((Visibility.BODY, -1), (Visibility.SIGNALLED, 0)):
        scene = vehicles({**ego, "visibility": int(seen)}, enters, slow)
        assert mobil_changes(perceive(scene, road), road, mobil=SELFISH)[0, 1] == goes


# Afterwards

EGO, ENTERS, SLOW, FOLLOWS = range(4)


def merges(rows: int, seed: int, mobil: MobilParameters = SELFISH) -> Vehicles:
    """Scenes in which one has just decided to enter the lane of another, whatever their speeds and distances.

    The ego is far away; a slow car makes the one in front of it want the other lane.
    """
    generator = torch.Generator().manual_seed(seed)

    def between(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(rows, generator=generator, dtype=DOUBLE)

    x = torch.stack((between(5000, 5001), between(0, 0), between(7.5, 85), between(-125, -5)), dim=1)
    speed = torch.stack((between(20, 21), between(0, 30), between(0, 25), between(0, 35)), dim=1)
    desired = torch.maximum(torch.stack([between(10, 40) for _ in range(4)], dim=1), 0.8 * speed)
    lane = torch.tensor([0, 0, 0, 1]).expand(rows, -1)
    zero = torch.zeros_like(x)
    seen = torch.full_like(lane, int(Visibility.SIGNALLED))
    scene = Vehicles(x, 4.0 * lane, zero, speed, zero, zero + 4.5, zero + 2.5, desired, lane, seen, lane >= 0)
    road = Road(lanes=2)
    change = mobil_changes(perceive(scene, road), road, mobil=mobil)
    goes = change[:, ENTERS] == 1
    scene = scene.with_(target_lane=lane + change * (torch.arange(4) == ENTERS))
    return Vehicles(*(value[goes] for value in scene.as_dict().values()))


def demand(scene: Vehicles) -> torch.Tensor:
    """What the one that enters asks of its new follower, m/s2, [N]."""
    v, gap = scene, scene.x[:, ENTERS] - scene.x[:, FOLLOWS] - 4.5
    return idm_acceleration(v.speed[:, FOLLOWS], v.desired_speed[:, FOLLOWS], gap, v.speed[:, ENTERS])


def demands(scene: Vehicles, seconds: float, braking: float) -> torch.Tensor:
    """:func:`demand` at every step of the change, [steps, N].

    The one that enters drives like everybody else but never brakes, or brakes all the time, by ``braking`` m/s2.
    """
    traffic = IdmTraffic(Road(lanes=2))
    clock = torch.zeros(scene.x.shape[0], dtype=torch.int64)
    memory, film = traffic.fresh_memory(scene, clock), [demand(scene)]
    enters = torch.arange(4) == ENTERS
    for _ in range(round(seconds / keys.PHYSICS_STEP_S)):
        moved, memory = traffic.move(scene, memory, clock, clock)
        braked = (scene.speed - braking * keys.PHYSICS_STEP_S).clamp_min(0.0)
        its_own = braked if braking else torch.maximum(moved.speed, scene.speed)
        scene = moved.with_(speed=torch.where(enters, its_own, moved.speed))
        film.append(demand(scene))
    return torch.stack(film)


def test_nor_is_the_new_follower_asked_for_more_than_b_safe_while_the_one_ahead_does_not_brake():
    """IDM calms down by itself: a demand may grow to the comfortable deceleration; what is above that shrinks."""
    film = demands(merges(rows=20_000, seed=2), seconds=8.0, braking=0.0)
    assert film.shape[1] > 5000
    assert film.min() >= -B_SAFE
    assert (film >= film[0].clamp_max(-TABLE_V.comfortable_deceleration) - 1e-9).all()
    hard = film[0] < -0.75 * B_SAFE
    assert hard.sum() > 100
    assert (film[1:, hard] > film[0, hard]).all()


def test_it_is_asked_for_more_where_the_one_ahead_brakes_or_where_b_safe_is_another():
    film = demands(merges(rows=4000, seed=3), seconds=8.0, braking=8.0)
    assert film[0].min() >= -B_SAFE
    assert film.min() < -1.5 * B_SAFE, film.min()
    bold = replace(SELFISH, safe_deceleration=2.0 * B_SAFE)
    assert demand(merges(rows=4000, seed=3, mobil=bold)).min() < -B_SAFE
