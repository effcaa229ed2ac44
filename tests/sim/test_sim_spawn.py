"""Random first scenes.

Table II, no overlap, the ego in the middle, lorries, and everybody can still brake.
"""

import math
import re
from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.refusals import user_error
from reference.worlds import DOUBLE, episode_keys, packed

from ganlane.settings.driving import Visibility
from ganlane.settings.env import EnvConfig
from ganlane.settings.episode import SpawnParameters
from ganlane.settings.record import make
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.idm import TABLE_V, can_brake
from ganlane.sim.spawn import RandomScenes, check_start, draw_lanes
from ganlane.sim.state import Road

LORRIES = SpawnParameters(truck_share=0.3)
KEYS = episode_keys(range(2000))


def scenes(count=2000, vehicles=9, **others):
    return RandomScenes(Road(), vehicles, **others)(KEYS[:count], DOUBLE)


def smallest_spacing(s, gaps=False):
    """Between centres in one lane, or bumper to bumper, m."""
    apart = (s.x[:, :, None] - s.x[:, None, :]).abs()
    same = (s.target_lane[:, :, None] == s.target_lane[:, None, :]) & (apart > 0)
    bumpers = 0.5 * (s.length[:, :, None] + s.length[:, None, :]) if gaps else 0.0
    return torch.where(same, apart - bumpers, torch.inf).min().item()


def fills(value, low, high):
    """Whether values stay in a range and reach from end to end of it."""
    ends = torch.stack((value.min() - low, high - value.max()))
    return bool(((ends >= 0.0) & (ends <= 0.01 * (high - low))).all())


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
    assert ((s.x[:, 1:] < 0).sum(1) == (vehicles - 1) // 2).all()
    assert (s.x[:, 1:] != 0.0).all()
    assert (s.x[:, 1:].diff(dim=1) > 0).all()


def test_the_ego_has_a_visibility_of_its_own():
    s = scenes(5, ego_visibility=Visibility.CENTRE, others_visibility=Visibility.SIGNALLED)
    assert (s.visibility[:, 0] == Visibility.CENTRE).all()
    assert (s.visibility[:, 1:] == Visibility.SIGNALLED).all()


@pytest.mark.parametrize(
    ("changed", "what"),
    [
        ({"front_speed_mps": (-5.0, 12.0)}, "front_speed_mps=[-5,12]: expected two numbers"),
        ({"ego_speed_mps": (10.0, math.nan)}, "ego_speed_mps=[10,nan]: expected two numbers"),
        ({"desired_speed_mps": (18.0, math.inf)}, "desired_speed_mps=[18,inf]: expected two"),
        ({"desired_speed_mps": (0.0, 26.0)}, "desired_speed_mps=[0,26]: expected two numbers"),
        ({"truck_share": 1.1}, "truck_share=1.1: expected a number from 0 to 1"),
    ],
)
def test_impossible_numbers_are_refused_by_name(changed, what):
    with user_error("^" + re.escape(what)):
        SpawnParameters(**changed)


def test_every_lane_is_as_likely_as_the_others():
    """A vehicle takes one of 27 places.

    Chi-square with 2 degrees of freedom stays under 13.8 (p = 0.001).
    """
    lanes = draw_lanes(episode_keys(range(9000)), 9, 3, 9)[:, 4]
    counts = torch.bincount(lanes, minlength=3).double()
    assert ((counts - 3000) ** 2 / 3000).sum() < 13.8


@settings(max_examples=20)
@given(
    data=st.data(),
    lanes=st.integers(1, 6),
    spacing=st.floats(5.0, 40.0),
    spread=st.floats(40.0, 1000.0),
)
def test_no_scene_starts_with_an_overlap(data, lanes, spacing, spread):
    p = packed(spread, spacing)
    vehicles = data.draw(st.integers(1, min(60, lanes * p.lane_capacity())))
    check_start(p, vehicles, lanes)
    key = episode_keys(range(4), seed=data.draw(st.integers(0, 2**40)))
    s = RandomScenes(Road(lanes), vehicles, p)(key, DOUBLE)
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
        (
            SpawnParameters(min_spacing_m=10.0),
            9,
            r"rear_speed_mps up to 25 m/s.*lower rear_speed_mps to 17\.7",
        ),
        (
            SpawnParameters(ego_speed_mps=(10.0, 60.0)),
            9,
            "ego_speed_mps up to 60.*lower ego_speed_mps to",
        ),
        (
            SpawnParameters(front_speed_mps=(0.0, 40.0)),
            9,
            "front_speed_mps up to 40.*raise min_spacing_m to",
        ),
    ],
)
def test_vehicles_that_do_not_fit_or_cannot_brake_are_refused_in_a_sentence(
    parameters, vehicles, sentence
):
    with user_error(sentence):
        check_start(parameters, vehicles, 3)


def test_weak_brakes_make_table_ii_hopeless():
    with user_error(r"idm\.min_acceleration=-5"):
        check_start(SpawnParameters(), 9, 3, replace(TABLE_V, min_acceleration=-5.0))


@pytest.mark.parametrize("other", [Road(2), Road(3, 3.5), Road(3, 4.0, ring_m=500.0)])
def test_random_scenes_are_laid_out_on_the_environments_road(other):
    RandomScenes(other).check(other, TABLE_V)
    with user_error(r"a straight road of 3 lanes of 4\.0 m"):
        RandomScenes(Road(3)).check(other, TABLE_V)


#: Lanes no wider than a car; a ring without room for 200 m and 25 m between the last vehicle and
#: the first.
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
    with nullcontext() if sentence is None else user_error(sentence):
        RandomScenes(road, parameters=parameters).check(road, TABLE_V)


# Lorries


def test_lorries_are_the_share_asked_for_and_want_80_to_90_km_an_hour():
    """16,000 others; four standard deviations are 0.0145."""
    others = scenes(parameters=LORRIES).columns(slice(1, None))
    lorry = others.length == 12.0
    assert lorry.double().mean().item() == pytest.approx(0.3, abs=0.0145)
    assert (lorry | (others.length == 4.5)).all()
    assert torch.equal(others.width, torch.full_like(others.x, 2.5))
    assert fills(others.desired_speed[lorry], 22.0, 25.0)
    assert fills(others.desired_speed[~lorry], 18.0, 26.0)


def test_the_ego_is_never_a_lorry():
    all_lorries = scenes(parameters=SpawnParameters(truck_share=1.0))
    assert (all_lorries.length == torch.tensor([4.5] + [12.0] * 8)).all()
    assert (all_lorries.desired_speed[:, 0] == 25.0).all()


@pytest.mark.parametrize("share", [0.05, 0.3, 1.0])
def test_everybody_can_brake_whoever_is_a_lorry(share):
    """Two cars keep 20.5 m at least, and so do two lorries.

    The worst follower of Table II needs 13.3 m.
    """
    p = SpawnParameters(truck_share=share)
    assert p.lane_capacity() == 7
    RandomScenes(parameters=p).check(Road(), TABLE_V)
    s = scenes(vehicles=21, parameters=p)
    assert smallest_spacing(s, gaps=True) >= 20.5 - 1e-9
    assert can_brake(20.5, 25.0, 10.0, 26.0)
    assert not can_brake(25.0 - 12.0, 25.0, 10.0, 26.0)
    assert not pair_overlaps(s).any()
    assert (s.x.amax(1) - s.x.amin(1)).max() <= 200.0


def test_too_wide_a_lorry_and_lorries_in_a_scene_set_by_hand_are_refused_on_the_command_line():
    with user_error(r"more than truck_width_m=4"):
        EnvConfig(truck_share=0.1, truck_width_m=4.0)
    EnvConfig(truck_width_m=4.0)  # without lorries nobody is so wide
    with user_error(r"truck_share=0\.2: has no effect on a scene set by hand"):
        make(EnvConfig, {"name": "cut_in", "truck_share": 0.2})
