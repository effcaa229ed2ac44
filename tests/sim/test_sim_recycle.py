"""Recycling: who falls out of the ego's range comes back on its other side, where there is room."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.marks import slow
from reference.worlds import (
    drawing,
    environment,
    placed,
    random_scenes,
    run,
    step,
    vehicles,
)

from ganlane import keys
from ganlane.agents.drivers import MobilDriver
from ganlane.settings.driving import Visibility
from ganlane.settings.episode import SpawnParameters
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.idm import TABLE_V, following_acceleration
from ganlane.sim.neighbours import perceive
from ganlane.sim.spawn import RANGE_M, SAFE_DECELERATION, recycle
from ganlane.sim.state import Road

# Recycling, by hand

ROAD = Road(lanes=3)
EGO = {"x": 1000.0, "lane": 1}
AWAY = {"x": 790.0}


@pytest.mark.parametrize(
    ("others", "after"),
    [
        # More than 200 m behind: 400 m ahead, and the reverse.
        ([AWAY, {"x": 1230.0, "lane": 2}], [1190.0, 830.0]),
        *([[{"x": x, "lane": 2}], [x]] for x in (800.0, 801.0, 1000.0, 1199.0, 1200.0)),
        # Padding stays and takes no room.
        ([{**AWAY, "valid": False}], [790.0]),
        ([AWAY, {"x": 1190.0, "valid": False}], [1190.0, 1190.0]),
        # At 20 m/s, within 4 m of another one in its lane, IDM asks for far more than 4 m/s2;
        # beside it for nothing.
        *([[AWAY, {"x": x}], [790.0, x]] for x in (1182.0, 1190.0, 1198.0)),
        *([[AWAY, {"x": x, "lane": 1}], [1190.0, x]] for x in (1182.0, 1190.0, 1198.0)),
        # 60 m behind: a follower at the same speed is fine, one that closes in at 20 m/s is not.
        ([AWAY, {"x": 1130.0, "speed": 20.0, "desired_speed": 40.0}], [1190.0, 1130.0]),
        ([AWAY, {"x": 1130.0, "speed": 40.0, "desired_speed": 40.0}], [790.0, 1130.0]),
        # In the middle of a change from lane 0 to lane 1 there has to be room in both.
        ([{**AWAY, "y": 0.5, "target_lane": 1}, {"x": 1185.0, "lane": 1}], [790.0, 1185.0]),
        ([{**AWAY, "y": 0.5, "target_lane": 1}, {"x": 1185.0, "lane": 2}], [1190.0, 1185.0]),
    ],
)
def test_who_is_out_of_range_goes_to_the_other_side_where_there_is_room(others, after):
    assert recycle(vehicles(EGO, *others), ROAD, TABLE_V).x[0].tolist() == [1000.0, *after]


def test_nobody_is_put_beside_one_that_has_hardly_left_the_lane():
    """Each in its own lane, but at an angle.

    The corners of two cars of 2.5 m, 2.6 m apart, would touch.
    """
    moved = {**AWAY, "y": 7.28, "heading": 0.03, "target_lane": 2, "width": 2.5}
    leaving = {"x": 1190.0, "y": 4.68, "heading": -0.06, "target_lane": 1, "width": 2.5}
    for other, x in ((leaving, 790.0), ({**leaving, "y": 4.0}, 1190.0)):
        assert recycle(vehicles(EGO, moved, other), ROAD, TABLE_V).x[0, 1] == x
    assert pair_overlaps(vehicles(EGO, {**moved, "x": 1190.0}, leaving)).any()


# Recycling, any scene


def scenes_around(rows, cars, lanes, seed):
    """On 1000 m around the ego, some in the middle of a change, some padding."""
    scene = random_scenes(rows, cars, lanes, seed)
    is_ego = torch.arange(cars) == keys.EGO_INDEX
    between = drawing((rows, cars), seed + 1)
    x = torch.where(is_ego, 1000.0, between(500, 1500))
    return scene.with_(x=x, valid=is_ego | (between(0, 1) < 0.9))


@settings(max_examples=20)
@given(seed=st.integers(0, 2**31), lanes=st.integers(1, 5), cars=st.integers(2, 25))
def test_positions_change_by_twice_the_range_the_ego_and_padding_never_move(seed, lanes, cars):
    before = scenes_around(20, cars, lanes, seed)
    after = recycle(before, Road(lanes), TABLE_V)
    moved = after.x - before.x
    distance = before.x - before.x[:, :1]
    across = -2.0 * RANGE_M * torch.sign(distance)
    may_go = before.valid & (distance.abs() > RANGE_M)
    may_go[:, keys.EGO_INDEX] = False
    assert ((moved == 0) | (may_go & ((moved - across).abs() < 1e-9))).all()


def burdened(before, after, road):
    """Who brakes harder than is safe because of one that came, or came and has to, bool [N, M].

    Compared with the scene that those who left have left, and in which they have not come back.
    """
    went = after.x != before.x
    gone = before.with_(valid=before.valid & ~went)
    was, now = (following_acceleration(perceive(scene, road)) for scene in (gone, after))
    was = torch.where(went, 0.0, was)
    return (now < was.clamp_max(-SAFE_DECELERATION) - 1e-9) & before.valid


def test_several_that_return_at_once_burden_nobody():
    road = Road(lanes=2)
    before = scenes_around(2000, 12, 2, seed=0)
    after = recycle(before, road, TABLE_V)
    assert (after.x != before.x).sum() > 1000
    assert not burdened(before, after, road).any()
    assert not (pair_overlaps(after) & ~pair_overlaps(before)).any()


# Recycling in the environment


def company_by_km(on, cars, rows, goal_m):
    """Mean number of others within 200 m of a MOBIL ego, in each kilometre."""
    spread = SpawnParameters(spread_m=max(200.0, 22.3 * cars))
    env = environment(num_envs=rows, vehicles=cars, goal_m=goal_m, spawn=spread, recycle=on)
    driver = MobilDriver(env.road)
    td = env.reset()
    seen = []
    running = torch.ones(rows, dtype=torch.bool)
    while running.any():
        td = env.step(driver(td))["next"]
        running &= ~td["done"][:, 0]
        seen.append(td[keys.VEHICLES, "x"][running])
    x = torch.cat(seen)
    near = ((x[:, 1:] - x[:, :1]).abs() <= RANGE_M).double().sum(1)
    km = x[:, 0] // 1000.0
    return [near[km == number].mean().item() for number in km.unique()]


@pytest.mark.parametrize(
    ("on", "cars", "rows", "goal_m", "least"),
    [
        (True, 9, 8, 1500.0, 7.5),
        slow(True, 9, 8, 5000.0, 7.5),
        slow(True, 30, 16, 5000.0, 20.0),
        slow(False, 9, 8, 5000.0, 4.0),
    ],
)
def test_with_it_the_ego_keeps_its_company_and_without_it_loses_it(on, cars, rows, goal_m, least):
    company = company_by_km(on, cars, rows, goal_m)
    if on:
        assert min(company) > least
    else:
        assert company[0] > 7.0
        assert company[-1] < least


@pytest.mark.parametrize("on", [True, False])
def test_rows_that_ended_are_not_recycled(on):
    """Row 0 reaches its goal in this decision, row 1 goes on; in both somebody is 250 m behind."""
    env = environment(num_envs=2, vehicles=2, mobil=False, goal_m=1015.0, recycle=on)
    row = vehicles({**EGO, "visibility": int(Visibility.BODY)}, {"x": 750.0})
    td = placed(env, row.part([0, 0]))
    td[keys.VEHICLES, "x"][1] -= 100.0
    after = step(env, td)
    assert after[keys.EVENTS, "goal"][:, 0].tolist() == [True, False]
    distance = after[keys.VEHICLES, "x"].diff()[:, 0].tolist()
    assert distance[0] == pytest.approx(-250.0, abs=2.0)
    assert distance[1] == pytest.approx(150.0 if on else -250.0, abs=2.0)


def far_behind(share, num_envs=32, first_episode=0):
    """Episodes [N] with somebody behind the range after 60 decisions at up to 35 m/s; a ``share``
    of them is recycled.
    """
    env = environment(
        num_envs=num_envs,
        spawn=SpawnParameters(ego_desired_speed_mps=35.0),
        first_episode=first_episode,
        recycle=True,
        recycle_share=share,
        dtype=torch.float32,
        kernel="auto",
    )
    *_, state = run(env, 60)
    x = state[keys.VEHICLES, "x"]
    return ((x[:, :1] - x) > RANGE_M + 40.0).any(1)


def test_only_a_share_of_the_episodes_is_recycled_and_the_same_ones_in_any_batch():
    never, half, everywhere = map(far_behind, (0.0, 0.5, 1.0))
    assert never.sum() > 8
    assert everywhere.sum() < 0.2 * never.sum()  # who finds no room waits
    assert 0.2 < half.sum() / never.sum() < 0.8
    assert torch.equal(half[8:12], far_behind(0.5, num_envs=4, first_episode=8))
