"""Recycling: who falls out of the ego's range comes back on its other side, where there is room."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.worlds import DOUBLE, environment, step, vehicles

from ganlane import keys
from ganlane.agents.drivers import MobilDriver
from ganlane.errors import UserError
from ganlane.parameters.driving import Visibility
from ganlane.parameters.episode import SpawnParameters
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.idm import TABLE_V, following_acceleration
from ganlane.sim.neighbours import perceive
from ganlane.sim.spawn import RANGE_M, SAFE_DECELERATION, recycle
from ganlane.sim.state import Road, Vehicles

ROAD = Road(lanes=3)
EGO = {"x": 1000.0, "lane": 1}


def recycled(*cars: dict) -> list[float]:
    """Positions after recycling, m."""
    return recycle(vehicles(*cars), ROAD, TABLE_V).x[0].tolist()


# By hand


def test_who_is_more_than_200_m_behind_goes_400_m_ahead_and_the_reverse():
    assert recycled(EGO, {"x": 790.0}, {"x": 1230.0, "lane": 2}) == [1000.0, 1190.0, 830.0]


@pytest.mark.parametrize("x", [800.0, 801.0, 1000.0, 1199.0, 1200.0])
def test_who_is_in_range_stays(x):
    assert recycled(EGO, {"x": x, "lane": 2}) == [1000.0, x]


def test_padding_stays_and_takes_no_room():
    away = {"x": 790.0}
    assert recycled(EGO, {**away, "valid": False}) == [1000.0, 790.0]
    assert recycled(EGO, away, {"x": 1190.0, "valid": False}) == [1000.0, 1190.0, 1190.0]


def test_a_vehicle_without_room_waits():
    """At 20 m/s, within 4 m of another one in its lane, IDM asks for far more than 4 m/s2; beside it for nothing."""
    for blocked in (1182.0, 1190.0, 1198.0):
        assert recycled(EGO, {"x": 790.0}, {"x": blocked}) == [1000.0, 790.0, blocked]
        assert recycled(EGO, {"x": 790.0}, {"x": blocked, "lane": 1}) == [1000.0, 1190.0, blocked]


def test_room_depends_on_speeds():
    """60 m behind: a follower at the same speed is fine, one that closes in at 20 m/s is not."""
    for speed, goes in ((20.0, True), (40.0, False)):
        follower = {"x": 1130.0, "speed": speed, "desired_speed": 40.0}
        assert recycled(EGO, {"x": 790.0}, follower)[1] == (1190.0 if goes else 790.0)


def test_it_is_seen_in_the_lane_that_it_signals_too():
    """In the middle of a change from lane 0 to lane 1 there has to be room in both."""
    changing = {"x": 790.0, "y": 0.5, "target_lane": 1}
    assert recycled(EGO, changing, {"x": 1185.0, "lane": 1})[1] == 790.0
    assert recycled(EGO, changing, {"x": 1185.0, "lane": 2})[1] == 1190.0


def test_nobody_is_put_beside_one_that_has_hardly_left_the_lane():
    """Each in its own lane, but at an angle: the corners of two cars of 2.5 m, 2.6 m apart, would touch."""
    moved = {"x": 790.0, "y": 7.28, "heading": 0.03, "target_lane": 2, "width": 2.5}
    leaving = {"x": 1190.0, "y": 4.68, "heading": -0.06, "target_lane": 1, "width": 2.5}
    assert recycled(EGO, moved, leaving)[1] == 790.0
    assert recycled(EGO, moved, {**leaving, "y": 4.0})[1] == 1190.0
    beside = vehicles(EGO, {**moved, "x": 1190.0}, leaving)
    assert pair_overlaps(beside).any()


def test_only_the_position_changes():
    before = vehicles(EGO, {"x": 790.0, "y": 0.3, "heading": 0.01, "speed": 17.0, "acceleration": 0.2})
    after = recycle(before, ROAD, TABLE_V)
    for name, value in before.as_dict().items():
        assert name == "x" or torch.equal(getattr(after, name), value)


# Any scene


def random_scenes(rows: int, cars: int, lanes: int, seed: int) -> Vehicles:
    """On 1000 m around the ego, at 0 to 35 m/s; some in the middle of a change, some padding; all of them signal."""
    generator = torch.Generator().manual_seed(seed)

    def between(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand((rows, cars), generator=generator, dtype=DOUBLE)

    lane = between(0, lanes).long()
    target = (lane + between(-1.2, 1.2).long()).clamp(0, lanes - 1)
    x, zero = between(500, 1500), torch.zeros((rows, cars), dtype=DOUBLE)
    x[:, keys.EGO_INDEX] = 1000.0
    valid = between(0, 1) < 0.9
    valid[:, keys.EGO_INDEX] = True
    speed = between(0, 35)
    return Vehicles(
        x=x,
        y=4.0 * (lane + (target - lane) * between(0, 1)),
        heading=zero,
        speed=speed,
        acceleration=zero,
        length=zero + 4.5,
        width=zero + 2.5,
        desired_speed=torch.maximum(between(10, 40), 0.9 * speed),
        target_lane=target,
        visibility=torch.full_like(lane, int(Visibility.SIGNALLED)),
        valid=valid,
    )


ANY = {"seed": st.integers(0, 2**31), "lanes": st.integers(1, 5), "cars": st.integers(2, 25)}


@settings(max_examples=50)
@given(**ANY)
def test_positions_change_by_twice_the_range_the_ego_and_padding_never_move(seed, lanes, cars):
    before = random_scenes(20, cars, lanes, seed)
    after = recycle(before, Road(lanes), TABLE_V)
    moved = after.x - before.x
    distance = before.x - before.x[:, :1]
    across = -2.0 * RANGE_M * torch.sign(distance)
    assert ((moved == 0) | ((moved - across).abs() < 1e-9)).all()
    assert (moved[:, keys.EGO_INDEX] == 0).all()
    assert (moved[~before.valid] == 0).all()
    assert (moved[distance.abs() <= RANGE_M] == 0).all()


@settings(max_examples=30)
@given(**ANY)
def test_a_row_comes_out_the_same_alone_and_among_others(seed, lanes, cars):
    scenes = random_scenes(7, cars, lanes, seed)
    together = recycle(scenes, Road(lanes), TABLE_V).x
    for row in range(7):
        alone = Vehicles(*(value[row : row + 1] for value in scenes.as_dict().values()))
        assert torch.equal(recycle(alone, Road(lanes), TABLE_V).x[0], together[row])


def burdened(before: Vehicles, after: Vehicles, road: Road) -> torch.Tensor:
    """Who brakes harder than is safe because of one that came, or came and has to, bool [N, M].

    Compared with the scene that those who left have left, and in which they have not come back.
    """
    went = after.x != before.x
    gone = before.with_(valid=before.valid & ~went)
    was, now = (following_acceleration(perceive(scene, road)) for scene in (gone, after))
    was = torch.where(went, 0.0, was)
    return (now < was.clamp_max(-SAFE_DECELERATION) - 1e-9) & before.valid


@settings(max_examples=50)
@given(**ANY)
def test_one_vehicle_that_returns_burdens_nobody(seed, lanes, cars):
    scenes = random_scenes(20, cars, lanes, seed)
    near = scenes.x.clamp(1000.0 - RANGE_M, 1000.0 + RANGE_M)
    first = torch.arange(cars) == 1
    before = scenes.with_(x=torch.where(first, scenes.x, near))
    after = recycle(before, Road(lanes), TABLE_V)
    assert not burdened(before, after, Road(lanes)).any()
    assert not (pair_overlaps(after) & ~pair_overlaps(before)).any()


def test_several_that_return_at_once_burden_nobody():
    road, before = Road(lanes=2), random_scenes(2000, 12, 2, seed=0)
    after = recycle(before, road, TABLE_V)
    assert (after.x != before.x).sum() > 1000
    assert not burdened(before, after, road).any()
    assert not (pair_overlaps(after) & ~pair_overlaps(before)).any()


# In the environment


class Spy:
    """Stands in for the environment's recycling and keeps what it did."""

    def __init__(self) -> None:
        self.moved, self.burdened, self.overlaps = 0, 0, 0

    def recycle(self, before: Vehicles, road: Road, idm: object) -> Vehicles:
        after = recycle(before, road, TABLE_V)
        self.moved += int((after.x != before.x).sum())
        self.burdened += int(burdened(before, after, road).sum())
        return after

    def record(self, cars: Vehicles, running: torch.Tensor) -> None:
        self.overlaps += int(pair_overlaps(cars)[running].sum()) // 2


def in_range_by_km(on: bool, cars: int = 9, goal_m: float = 5000.0, rows: int = 8) -> tuple[list[float], Spy]:
    """Mean number of others within 200 m of a MOBIL ego, in each kilometre; and what recycling did."""
    spread = SpawnParameters(spread_m=max(200.0, 22.3 * cars))
    env = environment(num_envs=rows, vehicles=cars, goal_m=goal_m, spawn=spread, recycle=on)
    spy, driver, td = Spy(), MobilDriver(env.road), env.reset()
    if on:
        env.physics.recycle, env.recorder = spy.recycle, spy.record
    seen: list[list[int]] = [[] for _ in range(round(goal_m / 1000.0) + 1)]
    running = torch.ones(rows, dtype=torch.bool)
    while running.any():
        td = env.step(driver(td))["next"]
        running &= ~td["done"][:, 0]
        x = td[keys.VEHICLES, "x"]
        near = ((x[:, 1:] - x[:, :1]).abs() <= RANGE_M).sum(1)
        for row in running.nonzero()[:, 0].tolist():
            seen[int(x[row, 0] // 1000.0)].append(int(near[row]))
    return [sum(counts) / len(counts) for counts in seen if counts], spy


@pytest.mark.slow
def test_without_recycling_the_ego_loses_its_company_over_5_km():
    alone, _ = in_range_by_km(on=False)
    assert alone[0] > 7.0
    assert alone[-1] < 4.0


@pytest.mark.parametrize("goal_m", [3000.0, pytest.param(5000.0, marks=pytest.mark.slow)])
def test_with_it_the_ego_keeps_its_company_and_nobody_is_burdened(goal_m):
    company, spy = in_range_by_km(on=True, goal_m=goal_m)
    assert min(company) > 7.5
    assert spy.moved > goal_m / 100.0
    assert (spy.burdened, spy.overlaps) == (0, 0)


@pytest.mark.slow
def test_among_30_vehicles_too_nobody_overlaps_or_is_burdened():
    company, spy = in_range_by_km(on=True, cars=30, rows=16)
    assert min(company) > 20.0
    assert (spy.burdened, spy.overlaps) == (0, 0)


@pytest.mark.parametrize("on", [True, False])
def test_rows_that_ended_are_not_recycled(on):
    """Row 0 reaches its goal in this decision, row 1 goes on; in both somebody is 250 m behind."""
    env = environment(num_envs=2, vehicles=2, mobil=False, goal_m=1015.0, recycle=on)
    td = env.reset()
    row = vehicles({**EGO, "visibility": int(Visibility.BODY)}, {"x": 750.0})
    for name, value in row.as_dict().items():
        td[keys.VEHICLES, name] = value.expand(2, 2).clone()
    td[keys.VEHICLES, "x"][1] -= 100.0
    after = step(env, td)
    assert after[keys.EVENTS, "goal"][:, 0].tolist() == [True, False]
    distance = (after[keys.VEHICLES, "x"][:, 1] - after[keys.VEHICLES, "x"][:, 0]).tolist()
    assert distance[0] == pytest.approx(-250.0, abs=2.0)
    assert distance[1] == pytest.approx(150.0 if on else -250.0, abs=2.0)


def test_an_environment_that_recycles_is_the_same_in_every_batch():
    together, one = (
        environment(num_envs=rows, recycle=True, first_episode=first) for rows, first in ((4, 0), (1, 2))
    )
    states = []
    for env in (together, one):
        td, driver = env.reset(), MobilDriver(env.road)
        for _ in range(60):
            td = env.step(driver(td))["next"]
        states.append(td[keys.VEHICLES, "x"])
    assert torch.equal(states[0][2], states[1][0])


# A share of the episodes


def far_behind(share: float, num_envs: int = 32, first_episode: int = 0) -> torch.Tensor:
    """Whether somebody is far more than 200 m behind the ego after 60 decisions at up to 35 m/s, bool [N]."""
    spawn = SpawnParameters(ego_desired_speed_mps=35.0)
    env = environment(num_envs=num_envs, spawn=spawn, first_episode=first_episode, recycle=True, recycle_share=share)
    state = env.reset()
    for _ in range(60):
        state = step(env, state, 0)
    x = state[keys.VEHICLES, "x"]
    return ((x[:, :1] - x) > RANGE_M + 40.0).any(1)


def test_only_a_share_of_the_episodes_is_recycled_and_the_same_ones_in_any_batch():
    never = far_behind(0.0)
    half = far_behind(0.5)
    assert never.sum() > 8
    assert far_behind(1.0).sum() < 0.2 * never.sum()  # who finds no room waits
    assert 0.2 < half.sum() / never.sum() < 0.8
    assert torch.equal(half[8:12], far_behind(0.5, num_envs=4, first_episode=8))


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan")])
def test_a_share_outside_0_to_1_is_refused(share):
    with pytest.raises(UserError, match="recycle_share"):
        environment(num_envs=2, recycle=True, recycle_share=share)
