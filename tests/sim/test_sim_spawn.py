"""Random initial scenes: Table II, no overlap, the ego in the middle, lorries, and everybody can still brake."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from reference.worlds import DOUBLE, packed, vehicles

from ganlane.config.env import EnvConfig
from ganlane.config.scenarios import CutInEnvConfig
from ganlane.errors import UserError
from ganlane.parameters.driving import Visibility
from ganlane.parameters.episode import SpawnParameters
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.idm import TABLE_V, can_brake
from ganlane.sim.mobil import safe_change
from ganlane.sim.neighbours import leader, perceive
from ganlane.sim.random import Purpose, episode_key, uniform
from ganlane.sim.spawn import RandomScenes, check_start, draw_lanes, ego_first, place_in_lanes, spawn
from ganlane.sim.state import Road, Vehicles

LORRIES = SpawnParameters(truck_share=0.3)


def keys(count: int, seed: int = 0) -> torch.Tensor:
    return episode_key(0, torch.full((count,), seed), torch.arange(count))


def scenes(count: int = 2000, vehicles: int = 9, lanes: int = 3, **others) -> Vehicles:
    return spawn(keys(count), vehicles, lanes, 4.0, dtype=DOUBLE, **others)


def smallest_spacing(scene: Vehicles) -> float:
    """Between centres in one lane, m."""
    distance = (scene.x[:, :, None] - scene.x[:, None, :]).abs()
    same = scene.target_lane[:, :, None] == scene.target_lane[:, None, :]
    return torch.where(same & (distance > 0), distance, torch.inf).min().item()


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
    assert s.target_lane.min() == 0
    assert s.target_lane.max() == 2
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


def test_vehicles_that_do_not_fit_are_refused_in_a_sentence():
    with pytest.raises(UserError, match=r"^vehicles=28 do not fit: 3 lanes x 9"):
        check_start(SpawnParameters(), vehicles=28, lanes=3)
    check_start(SpawnParameters(), vehicles=27, lanes=3)


def test_a_spacing_within_the_length_of_a_car_is_refused():
    with pytest.raises(UserError, match="min_spacing_m=4"):
        check_start(SpawnParameters(min_spacing_m=4.0), vehicles=2, lanes=1)


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
        ({"truck_share": 1.5}, "truck_share=1.5: expected a number from 0 to 1"),
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
    lanes = draw_lanes(keys(9000), 9, 3, 9)[:, 4]
    counts = torch.bincount(lanes, minlength=3).double()
    assert ((counts - 3000) ** 2 / 3000).sum() < 13.8


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_a_scene_depends_on_its_key_alone(share):
    parameters = SpawnParameters(truck_share=share)
    together = scenes(20, parameters=parameters)
    for row in (0, 7, 19):
        alone = spawn(keys(20)[row : row + 1], 9, 3, 4.0, parameters, DOUBLE)
        for name, value in alone.as_dict().items():
            assert torch.equal(value[0], together.as_dict()[name][row]), name


def test_float32_and_float64_give_the_same_scene_to_rounding():
    single = spawn(keys(50), 9, 3, 4.0, dtype=torch.float32)
    double = scenes(50)
    assert torch.equal(single.target_lane, double.target_lane)
    for name in ("x", "speed", "desired_speed"):
        difference = getattr(single, name).double() - getattr(double, name)
        assert difference.abs().max() < 1e-4


@given(data=st.data(), lanes=st.integers(1, 6), spacing=st.floats(5.0, 40.0), spread=st.floats(40.0, 1000.0))
def test_no_scene_starts_with_an_overlap(data, lanes, spacing, spread):
    p = packed(spread, spacing)
    vehicles = data.draw(st.integers(1, min(60, lanes * p.lane_capacity())))
    check_start(p, vehicles, lanes)
    s = spawn(keys(4, seed=data.draw(st.integers(0, 2**40))), vehicles, lanes, 4.0, p, DOUBLE)
    assert not pair_overlaps(s).any()
    assert smallest_spacing(s) >= spacing - 1e-9
    assert (s.x.amax(1) - s.x.amin(1)).max() <= spread + 1e-9


# Lorries


def smallest_gap(s: Vehicles) -> float:
    """Bumper to bumper in one lane, m."""
    apart = (s.x[:, :, None] - s.x[:, None, :]).abs()
    same = (s.target_lane[:, :, None] == s.target_lane[:, None, :]) & (apart > 0)
    gap = apart - 0.5 * (s.length[:, :, None] + s.length[:, None, :])
    return torch.where(same, gap, torch.inf).min().item()


def test_the_share_of_lorries_is_the_one_asked_for():
    """16,000 others; four standard deviations are 0.0145."""
    others = scenes(parameters=LORRIES).columns(slice(1, None))
    lorry = others.length == 12.0
    assert lorry.double().mean().item() == pytest.approx(0.3, abs=0.0145)
    assert (lorry | (others.length == 4.5)).all()
    assert torch.equal(others.width, torch.full_like(others.x, 2.5))


def test_the_ego_is_never_a_lorry():
    all_lorries = scenes(parameters=SpawnParameters(truck_share=1.0))
    assert (all_lorries.length[:, 0] == 4.5).all()
    assert (all_lorries.length[:, 1:] == 12.0).all()
    assert (all_lorries.desired_speed[:, 0] == 25.0).all()


def test_lorries_want_80_to_90_km_an_hour_and_the_others_what_table_ii_says():
    others = scenes(parameters=LORRIES).columns(slice(1, None))
    lorry = others.length == 12.0
    assert 22.0 <= others.desired_speed[lorry].min() < 22.05
    assert 24.95 < others.desired_speed[lorry].max() <= 25.0
    assert 18.0 <= others.desired_speed[~lorry].min() < 18.05
    assert 25.95 < others.desired_speed[~lorry].max() <= 26.0


def test_more_lorries_are_the_same_ones_and_some_more_at_the_same_places():
    few, many = scenes(parameters=LORRIES), scenes(parameters=replace(LORRIES, truck_share=0.6))
    assert torch.equal(few.x, many.x)
    assert not ((few.length == 12.0) & (many.length == 4.5)).any()


def test_without_lorries_the_scene_is_table_iis_bit_for_bit():
    s = scenes(500, parameters=replace(LORRIES, truck_share=0.0))
    assert all(
        torch.equal(mine, table) for mine, table in zip(s, scenes(500, parameters=SpawnParameters()), strict=True)
    )
    lane = draw_lanes(keys(500), 9, 3, 9)
    u = uniform(keys(500), 0, 9, [Purpose.SPAWN_POSITION], DOUBLE)[..., 0]
    assert torch.equal(s.x, ego_first(place_in_lanes(lane, u, 200.0, 25.0), lane)[0])


@pytest.mark.parametrize("share", [0.05, 0.3, 1.0])
def test_everybody_can_brake_whoever_is_a_lorry(share):
    """Two cars keep 20.5 m at least, and so do two lorries: the worst follower of Table II needs 13.3 m."""
    p = SpawnParameters(truck_share=share)
    RandomScenes(parameters=p).check(Road(), TABLE_V)
    s = scenes(vehicles=21, parameters=p)
    assert smallest_gap(s) >= 20.5 - 1e-9
    assert can_brake(20.5, 25.0, 10.0, 26.0)
    assert not can_brake(25.0 - 12.0, 25.0, 10.0, 26.0)
    assert not pair_overlaps(s).any()
    assert (s.x.amax(1) - s.x.amin(1)).max() <= 200.0


def test_a_lane_holds_fewer_lorries_and_the_refusal_names_their_length():
    assert LORRIES.lane_capacity() == 7
    check_start(LORRIES, 21, 3)
    with pytest.raises(UserError, match=r"^vehicles=22 do not fit.*truck_length_m=12\) hold 21"):
        check_start(LORRIES, 22, 3)


def test_a_lorry_as_wide_as_its_lane_is_refused():
    with pytest.raises(UserError, match=r"more than truck_width_m=4"):
        EnvConfig(truck_share=0.1, truck_width_m=4.0)
    with pytest.raises(UserError, match=r"more than env\.truck_width_m=4"):
        RandomScenes(parameters=replace(LORRIES, truck_width_m=4.0)).check(Road(), TABLE_V)
    EnvConfig(truck_width_m=4.0)  # without lorries nobody is so wide


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan")])
def test_a_share_is_from_0_to_1(share):
    with pytest.raises(UserError, match=r"truck_share=.*expected a number from 0 to 1"):
        EnvConfig(truck_share=share)


def test_lorries_in_a_scene_set_by_hand_have_rows_of_their_own():
    with pytest.raises(UserError, match=r"truck_share=0\.2: has no effect on a scene set by hand"):
        CutInEnvConfig(truck_share=0.2)


def test_a_ring_must_have_room_for_them():
    with pytest.raises(UserError, match=r"ring_m=230.*env\.min_spacing_m=25 \(32\.5 with lorries\)"):
        RandomScenes(Road(ring_m=230.0), parameters=LORRIES).check(Road(ring_m=230.0), TABLE_V)


def test_followers_keep_off_the_rear_of_a_lorry_and_not_off_its_middle():
    """Centres 30 m apart, so 21.75 m are free; the lorry itself is 30 - 8.25 m behind the car ahead of it."""
    scene = perceive(
        vehicles({"x": 0.0}, {"x": 30.0, "length": 12.0}, {"x": 60.0}),
        Road(),
    )
    assert leader(scene, scene.body.low).gap[0, :2].tolist() == pytest.approx([21.75, 21.75])


@pytest.mark.parametrize(("length", "safe"), [(4.5, True), (12.0, False)])
def test_a_gap_that_is_safe_for_a_car_may_not_be_so_for_a_lorry(length, safe):
    """Centres 20 m apart, both at 20 m/s: 15.5 m are left behind a car, 11.75 m behind a lorry.

    IDM wants 34 m, so it asks for 0.7 (1 - 0.8^4 - (34 / gap)^2): -3.0 and -5.4 m/s2; safe is -4 m/s2.
    """
    scene = perceive(vehicles({"x": 0.0, "lane": 0, "length": length}, {"x": -20.0, "lane": 1}), Road())
    lane = torch.tensor([[1.0, 0.0]], dtype=DOUBLE)
    assert safe_change(scene, lane, TABLE_V)[0, 0].item() is safe
