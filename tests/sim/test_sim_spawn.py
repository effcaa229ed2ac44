"""First scenes: Table II, no overlap, the ego in the middle."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from reference.worlds import DOUBLE, packed

from ganlane.errors import UserError
from ganlane.parameters.driving import Visibility
from ganlane.parameters.episode import SpawnParameters
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.random import episode_key
from ganlane.sim.spawn import check_start, draw_lanes, spawn
from ganlane.sim.state import Vehicles


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


def test_a_scene_depends_on_its_key_alone():
    together = scenes(20)
    for row in (0, 7, 19):
        alone = spawn(keys(20)[row : row + 1], 9, 3, 4.0, dtype=DOUBLE)
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
