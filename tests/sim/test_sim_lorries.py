"""First scenes with lorries: as many as asked for, never the ego, and everybody can still brake."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from reference.worlds import DOUBLE, vehicles

from ganlane.config.env import EnvConfig
from ganlane.config.scenarios import CutInEnvConfig
from ganlane.errors import UserError
from ganlane.parameters.episode import SpawnParameters
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.feasibility import can_brake
from ganlane.sim.idm import TABLE_V
from ganlane.sim.mobil import safe_change
from ganlane.sim.neighbours import leader, perceive
from ganlane.sim.random import Purpose, episode_key, uniform
from ganlane.sim.spawn import RandomScenes, check_start, draw_lanes, ego_first, place_in_lanes, spawn
from ganlane.sim.state import Road, Vehicles

LORRIES = SpawnParameters(truck_share=0.3)


def keys(count: int, seed: int = 0) -> torch.Tensor:
    return episode_key(0, torch.full((count,), seed), torch.arange(count))


def scenes(parameters: SpawnParameters, count: int = 2000, vehicles: int = 9) -> Vehicles:
    return spawn(keys(count), vehicles, 3, 4.0, parameters, DOUBLE)


def smallest_gap(s: Vehicles) -> float:
    """Bumper to bumper in one lane, m."""
    apart = (s.x[:, :, None] - s.x[:, None, :]).abs()
    same = (s.target_lane[:, :, None] == s.target_lane[:, None, :]) & (apart > 0)
    gap = apart - 0.5 * (s.length[:, :, None] + s.length[:, None, :])
    return torch.where(same, gap, torch.inf).min().item()


def test_the_share_of_lorries_is_the_one_asked_for():
    """16,000 others; four standard deviations are 0.0145."""
    others = scenes(LORRIES).columns(slice(1, None))
    lorry = others.length == 12.0
    assert lorry.double().mean().item() == pytest.approx(0.3, abs=0.0145)
    assert (lorry | (others.length == 4.5)).all()
    assert torch.equal(others.width, torch.full_like(others.x, 2.5))


def test_the_ego_is_never_a_lorry():
    all_lorries = scenes(SpawnParameters(truck_share=1.0))
    assert (all_lorries.length[:, 0] == 4.5).all()
    assert (all_lorries.length[:, 1:] == 12.0).all()
    assert (all_lorries.desired_speed[:, 0] == 25.0).all()


def test_lorries_want_80_to_90_km_an_hour_and_the_others_what_table_ii_says():
    others = scenes(LORRIES).columns(slice(1, None))
    lorry = others.length == 12.0
    assert 22.0 <= others.desired_speed[lorry].min() < 22.05
    assert 24.95 < others.desired_speed[lorry].max() <= 25.0
    assert 18.0 <= others.desired_speed[~lorry].min() < 18.05
    assert 25.95 < others.desired_speed[~lorry].max() <= 26.0


def test_who_is_a_lorry_does_not_depend_on_the_batch():
    together = scenes(LORRIES, 20)
    for row in (0, 7, 19):
        alone = spawn(keys(20)[row : row + 1], 9, 3, 4.0, LORRIES, DOUBLE)
        for name, value in alone.as_dict().items():
            assert torch.equal(value[0], together.as_dict()[name][row]), name


def test_more_lorries_are_the_same_ones_and_some_more_at_the_same_places():
    few, many = scenes(LORRIES), scenes(replace(LORRIES, truck_share=0.6))
    assert torch.equal(few.x, many.x)
    assert not ((few.length == 12.0) & (many.length == 4.5)).any()


def test_without_lorries_the_scene_is_table_iis_bit_for_bit():
    s = scenes(replace(LORRIES, truck_share=0.0), 500)
    assert all(torch.equal(mine, table) for mine, table in zip(s, scenes(SpawnParameters(), 500), strict=True))
    lane = draw_lanes(keys(500), 9, 3, 9)
    u = uniform(keys(500), 0, 9, [Purpose.SPAWN_POSITION], DOUBLE)[..., 0]
    assert torch.equal(s.x, ego_first(place_in_lanes(lane, u, 200.0, 25.0), lane)[0])


@pytest.mark.parametrize("share", [0.05, 0.3, 1.0])
def test_everybody_can_brake_whoever_is_a_lorry(share):
    """Two cars keep 20.5 m at least, and so do two lorries: the worst follower of Table II needs 13.3 m."""
    p = SpawnParameters(truck_share=share)
    RandomScenes(parameters=p).check(Road(), TABLE_V)
    s = scenes(p, vehicles=21)
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


@pytest.mark.parametrize(
    ("changed", "what"),
    [
        ({"truck_share": 1.5}, "truck_share=1.5: expected a number from 0 to 1"),
        ({"truck_length_m": 0.0}, "truck_length_m=0: expected a number above 0"),
        ({"truck_width_m": float("nan")}, "truck_width_m=nan: expected a number above 0"),
        (
            {"truck_desired_speed_mps": (0.0, 25.0)},
            "truck_desired_speed_mps=[0,25]: expected two numbers",
        ),
        ({"truck_desired_speed_mps": (25.0, 22.0)}, "truck_desired_speed_mps=[25,22]: expected two numbers"),
    ],
)
def test_impossible_lorries_are_refused_by_name(changed, what):
    with pytest.raises(UserError) as refused:
        replace(LORRIES, **changed)
    assert what in str(refused.value)


def test_a_lorry_as_wide_as_its_lane_is_refused():
    with pytest.raises(UserError, match=r"more than env\.truck_width_m=4"):
        EnvConfig(truck_share=0.1, truck_width_m=4.0)
    with pytest.raises(UserError, match=r"more than env\.truck_width_m=4"):
        RandomScenes(parameters=replace(LORRIES, truck_width_m=4.0)).check(Road(), TABLE_V)
    EnvConfig(truck_width_m=4.0)  # without lorries nobody is so wide


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan")])
def test_a_share_is_from_0_to_1(share):
    with pytest.raises(UserError, match=r"truck_share=.*expected a number from 0 to 1"):
        EnvConfig(truck_share=share)


def test_lorries_in_a_scene_set_by_hand_have_rows_of_their_own():
    with pytest.raises(UserError, match=r"env\.truck_share=0\.2: has no effect on a scene set by hand"):
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
