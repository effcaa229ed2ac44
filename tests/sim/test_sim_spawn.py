"""Random first scenes: Table II, no overlap, the ego in the middle, lorries, and everybody can still brake.

And recycling: who falls out of the ego's range comes back on its other side, where there is room.
"""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.worlds import DOUBLE, drawing, environment, packed, random_scenes, step, vehicles

from ganlane import keys
from ganlane.agents.drivers import MobilDriver
from ganlane.config.env import CutInEnvConfig, EnvConfig
from ganlane.errors import UserError
from ganlane.parameters.driving import Visibility
from ganlane.parameters.episode import SpawnParameters
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.idm import TABLE_V, can_brake, following_acceleration
from ganlane.sim.neighbours import perceive
from ganlane.sim.random import Purpose, episode_key, uniform
from ganlane.sim.spawn import (
    RANGE_M,
    SAFE_DECELERATION,
    RandomScenes,
    check_start,
    draw_lanes,
    ego_first,
    place_in_lanes,
    recycle,
    spawn,
)
from ganlane.sim.state import Road, Vehicles

LORRIES = SpawnParameters(truck_share=0.3)


def episode_keys(count: int, seed: int = 0) -> torch.Tensor:
    return episode_key(0, torch.full((count,), seed), torch.arange(count))


def scenes(count: int = 2000, vehicles: int = 9, lanes: int = 3, **others) -> Vehicles:
    return spawn(episode_keys(count), vehicles, lanes, 4.0, dtype=DOUBLE, **others)


def smallest_spacing(s: Vehicles, gaps: bool = False) -> float:
    """Between centres in one lane, or bumper to bumper, m."""
    apart = (s.x[:, :, None] - s.x[:, None, :]).abs()
    same = (s.target_lane[:, :, None] == s.target_lane[:, None, :]) & (apart > 0)
    bumpers = 0.5 * (s.length[:, :, None] + s.length[:, None, :]) if gaps else 0.0
    return torch.where(same, apart - bumpers, torch.inf).min().item()


def fills(value: torch.Tensor, low: float, high: float) -> bool:
    """Whether values stay in a range and reach from end to end of it."""
    margin = 0.01 * (high - low)
    return bool(low <= value.min() < low + margin and high - margin < value.max() <= high)


def test_speeds_and_desired_speeds_fill_the_ranges_of_table_ii():
    s = scenes()
    others = s.columns(slice(1, None))
    front = others.x > 0
    assert fills(others.speed[front], 10.0, 12.0)
    assert fills(others.speed[~front], 15.0, 25.0)
    assert fills(s.speed[:, 0], 10.0, 15.0)
    assert fills(others.desired_speed, 18.0, 26.0)
    assert (s.desired_speed[:, 0] == 25.0).all()


def test_vehicles_stand_on_lane_centres_within_200_m_and_25_m_apart_in_a_lane():
    s = scenes()
    assert (s.y == 4.0 * s.target_lane).all()
    assert (s.target_lane.min(), s.target_lane.max()) == (0, 2)
    assert (s.x.amax(1) - s.x.amin(1)).max() <= 200.0
    assert 25.0 - 1e-9 <= smallest_spacing(s) < 25.5
    assert (s.heading == 0).all()
    assert (s.length == 4.5).all()
    assert (s.width == 2.5).all()
    assert s.valid.all()


@pytest.mark.parametrize("vehicles", [1, 2, 5, 8, 9, 20])
def test_the_ego_is_the_vehicle_in_the_middle_and_stands_at_zero(vehicles):
    s = scenes(200, vehicles)
    assert (s.x[:, 0] == 0.0).all()
    assert ((s.x < 0).sum(1) == (vehicles - 1) // 2).all()
    assert ((s.x > 0).sum(1) == vehicles - 1 - (vehicles - 1) // 2).all()
    assert (s.x[:, 1:].diff(dim=1) > 0).all()


def test_the_ego_has_a_visibility_of_its_own():
    s = scenes(5, ego_visibility=Visibility.CENTRE, others_visibility=Visibility.SIGNALLED)
    assert (s.visibility[:, 0] == Visibility.CENTRE).all()
    assert (s.visibility[:, 1:] == Visibility.SIGNALLED).all()


def test_a_full_road_holds_nine_vehicles_a_lane():
    assert SpawnParameters().lane_capacity() == 9
    s = scenes(50, vehicles=27)
    assert (torch.nn.functional.one_hot(s.target_lane, 3).sum(1) == 9).all()
    assert smallest_spacing(s) == pytest.approx(25.0)


@pytest.mark.parametrize(
    ("changed", "what"),
    [
        ({"front_speed_mps": (-5.0, 12.0)}, "front_speed_mps=[-5,12]: expected two numbers [low, high], 0 <= low"),
        ({"rear_speed_mps": (25.0, 15.0)}, "rear_speed_mps=[25,15]: expected two numbers [low, high], 0 <= low"),
        ({"ego_speed_mps": (math.nan, 15.0)}, "ego_speed_mps=[nan,15]: expected two numbers [low, high], 0 <= low"),
        ({"ego_speed_mps": (10.0, math.nan)}, "ego_speed_mps=[10,nan]: expected two numbers [low, high], 0 <= low"),
        ({"desired_speed_mps": (18.0, math.inf)}, "desired_speed_mps=[18,inf]: expected two numbers"),
        ({"desired_speed_mps": (0.0, 26.0)}, "desired_speed_mps=[0,26]: expected two numbers [low, high], 0 < low"),
        ({"ego_desired_speed_mps": 0.0}, "ego_desired_speed_mps=0: expected a number above 0"),
        ({"length_m": 0.0}, "length_m=0: expected a number above 0"),
        ({"width_m": -2.5}, "width_m=-2.5: expected a number above 0"),
        ({"spread_m": math.nan}, "spread_m=nan: expected a number above 0"),
        ({"min_spacing_m": math.inf}, "min_spacing_m=inf: expected a number above 0"),
        *(({"truck_share": share}, f"truck_share={share}: expected a number from 0 to 1") for share in (-0.1, 1.1)),
        ({"truck_share": math.nan}, "truck_share=nan: expected a number from 0 to 1"),
        ({"truck_length_m": 0.0}, "truck_length_m=0: expected a number above 0"),
        ({"truck_width_m": math.nan}, "truck_width_m=nan: expected a number above 0"),
        ({"truck_desired_speed_mps": (0.0, 25.0)}, "truck_desired_speed_mps=[0,25]: expected two numbers"),
        ({"truck_desired_speed_mps": (25.0, 22.0)}, "truck_desired_speed_mps=[25,22]: expected two numbers"),
    ],
)
def test_impossible_numbers_are_refused_by_name(changed, what):
    with pytest.raises(UserError) as refused:
        SpawnParameters(**changed)
    assert str(refused.value).startswith(what)


def test_every_lane_is_as_likely_as_the_others():
    """A vehicle takes one of 27 places; chi-square with 2 degrees of freedom stays under 13.8 (p = 0.001)."""
    lanes = draw_lanes(episode_keys(9000), 9, 3, 9)[:, 4]
    counts = torch.bincount(lanes, minlength=3).double()
    assert ((counts - 3000) ** 2 / 3000).sum() < 13.8


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_a_scene_depends_on_its_key_alone(share):
    parameters = SpawnParameters(truck_share=share)
    together = scenes(20, parameters=parameters)
    for row in (0, 7, 19):
        alone = spawn(episode_keys(20)[row : row + 1], 9, 3, 4.0, parameters, DOUBLE)
        for name, one, all_ in zip(alone._fields, alone, together):
            assert torch.equal(one[0], all_[row]), name


def test_float32_and_float64_give_the_same_scene_to_rounding():
    single, double = spawn(episode_keys(50), 9, 3, 4.0, dtype=torch.float32), scenes(50)
    assert torch.equal(single.target_lane, double.target_lane)
    for name in ("x", "speed", "desired_speed"):
        difference = getattr(single, name).double() - getattr(double, name)
        assert difference.abs().max() < 1e-4


@given(data=st.data(), lanes=st.integers(1, 6), spacing=st.floats(5.0, 40.0), spread=st.floats(40.0, 1000.0))
def test_no_scene_starts_with_an_overlap(data, lanes, spacing, spread):
    p = packed(spread, spacing)
    vehicles = data.draw(st.integers(1, min(60, lanes * p.lane_capacity())))
    check_start(p, vehicles, lanes)
    s = spawn(episode_keys(4, seed=data.draw(st.integers(0, 2**40))), vehicles, lanes, 4.0, p, DOUBLE)
    assert not pair_overlaps(s).any()
    assert smallest_spacing(s) >= spacing - 1e-9
    assert (s.x.amax(1) - s.x.amin(1)).max() <= spread + 1e-9


# Scenes that cannot be


@pytest.mark.parametrize(
    ("parameters", "vehicles", "sentence"),
    [
        (SpawnParameters(), 28, r"^vehicles=28 do not fit: 3 lanes x 9"),
        (LORRIES, 22, r"^vehicles=22 do not fit.*truck_length_m=12\) hold 21"),
        (SpawnParameters(min_spacing_m=4.0), 2, "min_spacing_m=4"),
        (SpawnParameters(min_spacing_m=10.0), 9, r"rear_speed_mps up to 25 m/s.*lower rear_speed_mps to 17\.7"),
        (SpawnParameters(ego_speed_mps=(10.0, 60.0)), 9, "ego_speed_mps up to 60.*lower ego_speed_mps to"),
        (SpawnParameters(front_speed_mps=(0.0, 40.0)), 9, "front_speed_mps up to 40.*raise min_spacing_m to"),
    ],
)
def test_vehicles_that_do_not_fit_or_cannot_brake_are_refused_in_a_sentence(parameters, vehicles, sentence):
    with pytest.raises(UserError, match=sentence):
        check_start(parameters, vehicles, 3)


@pytest.mark.parametrize(
    ("parameters", "vehicles"),
    [
        (SpawnParameters(), 27),
        (LORRIES, 21),
        # The remedies that the message names work.
        (SpawnParameters(min_spacing_m=17.8), 9),
        (SpawnParameters(min_spacing_m=10.0, rear_speed_mps=(15.0, 17.7)), 9),
    ],
)
def test_others_are_not(parameters, vehicles):
    check_start(parameters, vehicles, 3)


def test_weak_brakes_make_table_ii_hopeless():
    with pytest.raises(UserError, match=r"idm\.min_acceleration=-5"):
        check_start(SpawnParameters(), 9, 3, replace(TABLE_V, min_acceleration=-5.0))


@pytest.mark.parametrize("other", [Road(2), Road(3, 3.5), Road(3, 4.0, ring_m=500.0)])
def test_random_scenes_are_laid_out_on_the_environments_road(other):
    RandomScenes(other).check(other, TABLE_V)
    with pytest.raises(UserError, match=r"a straight road of 3 lanes of 4\.0 m"):
        RandomScenes(Road(3)).check(other, TABLE_V)


#: Lanes no wider than a car; a ring without room for 200 m and 25 m between the last vehicle and the first.
WIDTH = r"env\.lane_width_m={}: expected more than env\.width_m=2\.5"
RING = r"ring_m=224: expected at least env\.spread_m=200 and env\.min_spacing_m=25"


@pytest.mark.parametrize(
    ("road", "parameters", "sentence"),
    [
        (Road(3, 2.4), SpawnParameters(), WIDTH.format(2.4)),
        (Road(3, 2.5), SpawnParameters(), WIDTH.format(2.5)),
        (Road(3, 2.6), SpawnParameters(), None),
        (Road(), replace(LORRIES, truck_width_m=4.0), r"more than env\.truck_width_m=4"),
        (Road(ring_m=224.0), SpawnParameters(), RING),
        (Road(ring_m=225.0), SpawnParameters(), None),
        (Road(ring_m=230.0), LORRIES, r"ring_m=230.*env\.min_spacing_m=25 \(32\.5 with lorries\)"),
    ],
)
def test_a_road_must_be_wide_and_a_ring_long_enough(road, parameters, sentence):
    random = RandomScenes(road, parameters=parameters)
    if sentence is None:
        random.check(road, TABLE_V)
    else:
        with pytest.raises(UserError, match=sentence):
            random.check(road, TABLE_V)


# Lorries


def test_lorries_are_the_share_asked_for_and_want_80_to_90_km_an_hour():
    """16,000 others; four standard deviations are 0.0145."""
    others = scenes(parameters=LORRIES).columns(slice(1, None))
    lorry = others.length == 12.0
    assert lorry.double().mean().item() == pytest.approx(0.3, abs=0.0145)
    assert (lorry | (others.length == 4.5)).all()
    assert torch.equal(others.width, torch.full_like(others.x, 2.5))
    for found, low, high in ((others.desired_speed[lorry], 22.0, 25.0), (others.desired_speed[~lorry], 18.0, 26.0)):
        assert low <= found.min() < low + 0.05
        assert high - 0.05 < found.max() <= high


def test_the_ego_is_never_a_lorry():
    all_lorries = scenes(parameters=SpawnParameters(truck_share=1.0))
    assert (all_lorries.length[:, 0] == 4.5).all()
    assert (all_lorries.length[:, 1:] == 12.0).all()
    assert (all_lorries.desired_speed[:, 0] == 25.0).all()


def test_more_lorries_are_the_same_ones_and_some_more_at_the_same_places():
    few, many = scenes(parameters=LORRIES), scenes(parameters=replace(LORRIES, truck_share=0.6))
    assert torch.equal(few.x, many.x)
    assert not ((few.length == 12.0) & (many.length == 4.5)).any()


def test_without_lorries_the_scene_is_table_iis_bit_for_bit():
    s = scenes(500, parameters=replace(LORRIES, truck_share=0.0))
    assert all(map(torch.equal, s, scenes(500, parameters=SpawnParameters())))
    lane = draw_lanes(episode_keys(500), 9, 3, 9)
    u = uniform(episode_keys(500), 0, 9, [Purpose.SPAWN_POSITION], DOUBLE)[..., 0]
    assert torch.equal(s.x, ego_first(place_in_lanes(lane, u, 200.0, 25.0), lane)[0])


@pytest.mark.parametrize("share", [0.05, 0.3, 1.0])
def test_everybody_can_brake_whoever_is_a_lorry(share):
    """Two cars keep 20.5 m at least, and so do two lorries: the worst follower of Table II needs 13.3 m."""
    p = SpawnParameters(truck_share=share)
    assert p.lane_capacity() == 7
    RandomScenes(parameters=p).check(Road(), TABLE_V)
    s = scenes(vehicles=21, parameters=p)
    assert smallest_spacing(s, gaps=True) >= 20.5 - 1e-9
    assert can_brake(20.5, 25.0, 10.0, 26.0)
    assert not can_brake(25.0 - 12.0, 25.0, 10.0, 26.0)
    assert not pair_overlaps(s).any()
    assert (s.x.amax(1) - s.x.amin(1)).max() <= 200.0


def test_a_lorry_as_wide_as_its_lane_and_lorries_in_a_scene_set_by_hand_are_refused_on_the_command_line():
    with pytest.raises(UserError, match=r"more than truck_width_m=4"):
        EnvConfig(truck_share=0.1, truck_width_m=4.0)
    EnvConfig(truck_width_m=4.0)  # without lorries nobody is so wide
    with pytest.raises(UserError, match=r"truck_share=0\.2: has no effect on a scene set by hand"):
        CutInEnvConfig(truck_share=0.2)


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
        # At 20 m/s, within 4 m of another one in its lane, IDM asks for far more than 4 m/s2; beside it for nothing.
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
    """Each in its own lane, but at an angle: the corners of two cars of 2.5 m, 2.6 m apart, would touch."""
    moved = {**AWAY, "y": 7.28, "heading": 0.03, "target_lane": 2, "width": 2.5}
    leaving = {"x": 1190.0, "y": 4.68, "heading": -0.06, "target_lane": 1, "width": 2.5}
    for other, x in ((leaving, 790.0), ({**leaving, "y": 4.0}, 1190.0)):
        assert recycle(vehicles(EGO, moved, other), ROAD, TABLE_V).x[0, 1] == x
    assert pair_overlaps(vehicles(EGO, {**moved, "x": 1190.0}, leaving)).any()


def test_only_the_position_changes():
    before = vehicles(EGO, {**AWAY, "y": 0.3, "heading": 0.01, "speed": 17.0, "acceleration": 0.2})
    after = recycle(before, ROAD, TABLE_V)
    assert [name for name, a, b in zip(before._fields, before, after) if not torch.equal(a, b)] == ["x"]


# Recycling, any scene


def scenes_around(rows: int, cars: int, lanes: int, seed: int) -> Vehicles:
    """On 1000 m around the ego, some in the middle of a change, some padding."""
    scene, is_ego = random_scenes(rows, cars, lanes, seed), torch.arange(cars) == keys.EGO_INDEX
    between = drawing((rows, cars), seed + 1)
    x = torch.where(is_ego, 1000.0, between(500, 1500))
    return scene.with_(x=x, valid=is_ego | (between(0, 1) < 0.9))


ANY = {"seed": st.integers(0, 2**31), "lanes": st.integers(1, 5), "cars": st.integers(2, 25)}


@settings(max_examples=50)
@given(**ANY)
def test_positions_change_by_twice_the_range_the_ego_and_padding_never_move(seed, lanes, cars):
    before = scenes_around(20, cars, lanes, seed)
    after = recycle(before, Road(lanes), TABLE_V)
    moved = after.x - before.x
    distance = before.x - before.x[:, :1]
    across = -2.0 * RANGE_M * torch.sign(distance)
    assert ((moved == 0) | ((moved - across).abs() < 1e-9)).all()
    assert (moved[:, keys.EGO_INDEX] == 0).all()
    assert (moved[~before.valid] == 0).all()
    assert (moved[distance.abs() <= RANGE_M] == 0).all()
    # And a row comes out the same alone.
    alone = recycle(Vehicles(*(value[7:8] for value in before)), Road(lanes), TABLE_V)
    assert torch.equal(alone.x[0], after.x[7])


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
    around = scenes_around(20, cars, lanes, seed)
    near = around.x.clamp(1000.0 - RANGE_M, 1000.0 + RANGE_M)
    before = around.with_(x=torch.where(torch.arange(cars) == 1, around.x, near))
    after = recycle(before, Road(lanes), TABLE_V)
    assert not burdened(before, after, Road(lanes)).any()
    assert not (pair_overlaps(after) & ~pair_overlaps(before)).any()


def test_several_that_return_at_once_burden_nobody():
    road, before = Road(lanes=2), scenes_around(2000, 12, 2, seed=0)
    after = recycle(before, road, TABLE_V)
    assert (after.x != before.x).sum() > 1000
    assert not burdened(before, after, road).any()
    assert not (pair_overlaps(after) & ~pair_overlaps(before)).any()


# Recycling in the environment


def in_range_by_km(on: bool, cars: int = 9, goal_m: float = 5000.0, rows: int = 8) -> tuple[list[float], int]:
    """Mean number of others within 200 m of a MOBIL ego, in each kilometre; and how often one of them was moved.

    No vehicle overlaps another in a physics step, and none is burdened.
    """
    spread = SpawnParameters(spread_m=max(200.0, 22.3 * cars))
    env = environment(num_envs=rows, vehicles=cars, goal_m=goal_m, spawn=spread, recycle=on)
    driver, td, moved = MobilDriver(env.road), env.reset(), 0

    def spied(before: Vehicles, road: Road, idm: object) -> Vehicles:
        nonlocal moved
        after = recycle(before, road, TABLE_V)
        moved += int((after.x != before.x).sum())
        assert not burdened(before, after, road).any()
        return after

    def record(cars: Vehicles, running: torch.Tensor) -> None:
        assert not pair_overlaps(cars)[running].any()

    if on:
        env.physics.recycle, env.recorder = spied, record
    seen: list[list[int]] = [[] for _ in range(round(goal_m / 1000.0) + 1)]
    running = torch.ones(rows, dtype=torch.bool)
    while running.any():
        td = env.step(driver(td))["next"]
        running &= ~td["done"][:, 0]
        x = td[keys.VEHICLES, "x"]
        near = ((x[:, 1:] - x[:, :1]).abs() <= RANGE_M).sum(1)
        for row in running.nonzero()[:, 0].tolist():
            seen[int(x[row, 0] // 1000.0)].append(int(near[row]))
    return [sum(counts) / len(counts) for counts in seen if counts], moved


@pytest.mark.slow
def test_without_recycling_the_ego_loses_its_company_over_5_km():
    alone, _ = in_range_by_km(on=False)
    assert alone[0] > 7.0
    assert alone[-1] < 4.0


@pytest.mark.parametrize("goal_m", [3000.0, pytest.param(5000.0, marks=pytest.mark.slow)])
def test_with_it_the_ego_keeps_its_company_and_nobody_is_burdened(goal_m):
    company, moved = in_range_by_km(on=True, goal_m=goal_m)
    assert min(company) > 7.5
    assert moved > goal_m / 100.0


@pytest.mark.slow
def test_among_30_vehicles_too_nobody_overlaps_or_is_burdened():
    company, _ = in_range_by_km(on=True, cars=30, rows=16)
    assert min(company) > 20.0


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


def driven(share: float, num_envs: int = 32, first_episode: int = 0) -> torch.Tensor:
    """x [N, M] after 60 decisions at up to 35 m/s, where a ``share`` of the episodes is recycled."""
    spawn = SpawnParameters(ego_desired_speed_mps=35.0)
    env = environment(num_envs=num_envs, spawn=spawn, first_episode=first_episode, recycle=True, recycle_share=share)
    state = env.reset()
    for _ in range(60):
        state = step(env, state, 0)
    return state[keys.VEHICLES, "x"]


def test_only_a_share_of_the_episodes_is_recycled_and_the_same_ones_in_any_batch():
    never, half, all_of_them = map(driven, (0.0, 0.5, 1.0))
    left = [int(((x[:, :1] - x) > RANGE_M + 40.0).any(1).sum()) for x in (never, half, all_of_them)]
    assert left[0] > 8
    assert left[2] < 0.2 * left[0]  # who finds no room waits
    assert 0.2 < left[1] / left[0] < 0.8
    assert torch.equal(half[8:12], driven(0.5, num_envs=4, first_episode=8))


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan")])
def test_a_share_outside_0_to_1_is_refused(share):
    with pytest.raises(UserError, match="recycle_share"):
        environment(num_envs=2, recycle=True, recycle_share=share)
