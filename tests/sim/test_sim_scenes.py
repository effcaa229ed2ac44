"""Scenes set by hand start as they are written, vary as they are told, and hopeless ones are refused by name."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ganlane.errors import UserError
from ganlane.parameters.driving import Visibility
from ganlane.parameters.episode import SpawnParameters
from ganlane.sim.idm import TABLE_V, can_brake, highest_speed, least_gap, needed_deceleration
from ganlane.sim.random import Stream, episode_key
from ganlane.sim.scenarios import read_scene
from ganlane.sim.scenes import FixedScene, SceneVehicle
from ganlane.sim.spawn import RandomScenes, check_start
from ganlane.sim.state import Road

DOUBLE = torch.float64
ROAD = Road(2)


def keys(count: int, first: int = 0) -> torch.Tensor:
    episode = first + torch.arange(count)
    return episode_key(Stream.REPORT, torch.zeros_like(episode), episode)


def scene(*rows: SceneVehicle, **options: float) -> FixedScene:
    return FixedScene(rows, ROAD, **options)  # type: ignore[arg-type]


def pair(gap_m: float, speed: float, leader: float, **options: float) -> FixedScene:
    """The ego behind one vehicle, bumper to bumper so far apart."""
    return scene(SceneVehicle(0.0, 0, speed), SceneVehicle(gap_m + 4.5, 0, leader), **options)


# Braking


def test_a_stop_needs_speed_squared_over_twice_the_gap():
    needed = needed_deceleration(*(torch.tensor(value, dtype=DOUBLE) for value in (20.0, 0.0, 10.0)))
    assert needed.item() == pytest.approx(20.0)
    assert needed_deceleration(*(torch.tensor(value) for value in (10.0, 20.0, 0.5))).item() == 0.0


@pytest.mark.parametrize("speed", [2.0, 5.0, 12.0, 25.0, 36.0])
def test_idm_stops_within_the_kinematic_distance_and_a_step(speed):
    """At a closer gap the hardest braking cannot help; IDM asks for it from the first step on."""
    kinematic = speed * speed / (-2.0 * TABLE_V.min_acceleration)
    found = least_gap(speed, 0.0, 36.0)
    assert kinematic <= found <= kinematic + 0.05 * speed + 0.2
    assert not can_brake(0.95 * kinematic - 0.05, speed, 0.0, 36.0)


def test_a_leader_that_brakes_at_once_gives_away_its_own_braking_distance():
    assert least_gap(25.0, 0.0, 36.0) - least_gap(25.0, 10.0, 36.0) == pytest.approx(10.0**2 / 40.0, abs=0.15)


def test_highest_speed_and_least_gap_are_each_others_inverse():
    for gap in (1.5, 7.5, 20.5):
        speed = highest_speed(gap, 0.0, 36.0)
        assert can_brake(gap, speed, 0.0, 36.0)
        assert not can_brake(gap, speed + 0.2, 0.0, 36.0)
        assert least_gap(speed, 0.0, 36.0) <= gap + 0.11


@pytest.mark.parametrize("gap", [1.5, 7.5, 20.5])
def test_a_column_of_twelve_survives_where_a_pair_does(gap):
    """The leader stands, all the others come at the highest speed, each as close to the next as is allowed."""
    speed = highest_speed(gap, 0.0, 25.0)
    column = [SceneVehicle(-k * (gap + 4.5), 0, speed if k else 0.0, 25.0 if k else 0.001) for k in range(12)]
    ego_first = (column[5], *column[:5], *column[6:])
    FixedScene(ego_first, ROAD).check(ROAD, TABLE_V)
    faster = tuple(replace(car, speed_mps=1.05 * car.speed_mps) for car in ego_first)
    with pytest.raises(UserError, match=r"would need|crash"):
        FixedScene(faster, ROAD).check(ROAD, TABLE_V)


# Random scenes


def test_table_ii_can_be_driven():
    check_start(SpawnParameters(), 9, 3)


@pytest.mark.parametrize(
    ("parameters", "key", "remedy"),
    [
        (SpawnParameters(min_spacing_m=10.0), "rear_speed_mps up to 25 m/s", "lower rear_speed_mps to 17.7"),
        (SpawnParameters(ego_speed_mps=(10.0, 60.0)), "ego_speed_mps up to 60", "lower ego_speed_mps to"),
        (SpawnParameters(front_speed_mps=(0.0, 40.0)), "front_speed_mps up to 40", "raise min_spacing_m to"),
    ],
)
def test_ranges_that_nobody_can_brake_from_are_refused_with_the_field(parameters, key, remedy):
    with pytest.raises(UserError) as refused:
        check_start(parameters, 9, 3)
    assert key in str(refused.value)
    assert remedy in str(refused.value)


def test_the_remedies_that_the_message_names_work():
    check_start(SpawnParameters(min_spacing_m=17.8), 9, 3)
    check_start(SpawnParameters(min_spacing_m=10.0, rear_speed_mps=(15.0, 17.7)), 9, 3)


def test_weak_brakes_make_table_ii_hopeless():
    with pytest.raises(UserError, match=r"idm\.min_acceleration=-5"):
        check_start(SpawnParameters(), 9, 3, replace(TABLE_V, min_acceleration=-5.0))


def refusal(scenes: RandomScenes, road: Road) -> str:
    with pytest.raises(UserError) as refused:
        scenes.check(road, TABLE_V)
    return str(refused.value)


@pytest.mark.parametrize("other", [Road(2), Road(3, 3.5), Road(3, 4.0, ring_m=500.0)])
def test_random_scenes_are_laid_out_on_the_environments_road(other):
    RandomScenes(other).check(other, TABLE_V)
    assert "a straight road of 3 lanes of 4.0 m" in refusal(RandomScenes(Road(3)), other)


def test_lanes_no_wider_than_the_cars_are_refused():
    for width in (2.4, 2.5):
        said = refusal(RandomScenes(Road(3, width)), Road(3, width))
        assert f"env.lane_width_m={width}: expected more than env.width_m=2.5" in said
    RandomScenes(Road(3, 2.6)).check(Road(3, 2.6), TABLE_V)


def test_a_ring_must_have_room_for_the_spread_and_one_more_spacing():
    """Table II: 200 m and 25 m between the last vehicle and the first."""
    short, enough = Road(3, ring_m=224.0), Road(3, ring_m=225.0)
    assert "ring_m=224: expected at least env.spread_m=200 and env.min_spacing_m=25" in refusal(
        RandomScenes(short), short
    )
    RandomScenes(enough).check(enough, TABLE_V)


# Scenes set by hand


def test_the_ego_is_moved_to_zero_and_the_others_keep_their_distance():
    s = scene(SceneVehicle(100.0, 1, 20.0), SceneVehicle(140.0, 0, 10.0), SceneVehicle(60.0, 1, 15.0))
    v = s(keys(3), DOUBLE)
    assert v.x.tolist() == [[0.0, 40.0, -40.0]] * 3
    assert v.y[0].tolist() == [4.0, 0.0, 4.0]
    assert v.speed[0].tolist() == [20.0, 10.0, 15.0]
    assert v.target_lane[0].tolist() == [1, 0, 1]
    assert v.visibility[0].tolist() == [Visibility.BODY, Visibility.SIGNALLED, Visibility.SIGNALLED]


def test_jitter_follows_from_the_episode_alone_and_keeps_its_bounds():
    s = scene(SceneVehicle(0.0, 0, 20.0), SceneVehicle(90.0, 0, 0.0), SceneVehicle(-60.0, 1, 0.2), jitter_m=2.0)
    s = replace(s, jitter_mps=0.5)
    v = s(keys(1000), DOUBLE)
    assert (v.x[:, 0] == 0).all()
    assert 1.9 < (v.x[:, 1] - 90.0).abs().max() <= 2.0
    assert len(set(v.x[:, 1].tolist())) == 1000
    assert 0.45 < (v.speed[:, 0] - 20.0).abs().max() <= 0.5
    assert (v.speed[:, 1] == 0).all()
    assert (v.speed[:, 2] >= 0).all()
    alone = s(keys(1, first=700), DOUBLE)
    assert torch.equal(alone.x[0], v.x[700])
    assert torch.equal(alone.speed[0], v.speed[700])


@pytest.mark.parametrize(
    ("car", "what"),
    [
        (SceneVehicle(30.0, 2), "vehicle 1: lane=2: expected 0 to 1"),
        (SceneVehicle(30.0, y_m=5.5), "expected on the road, which runs from -2 to 6 m"),
        (SceneVehicle(30.0, 0, speed_mps=-1.0), "speed_mps=-1: expected at least 0"),
        (SceneVehicle(30.0, 0, desired_speed_mps=0.0), "desired_speed_mps=0: expected a number above 0"),
        (SceneVehicle(float("nan"), 0), "x_m=nan: expected a number from -1e+06 to 1e+06"),
        (SceneVehicle(30.0), "neither lane nor y_m"),
        (SceneVehicle(30.0, 0, y_m=4.0), "contradict each other"),
        (SceneVehicle(30.0, 0, target_lane=2), "target_lane=2: expected 0 to 1"),
        (SceneVehicle(4.0, 0), "the ego and vehicle 1 overlap"),
    ],
)
def test_an_impossible_vehicle_is_refused_by_name(car, what):
    with pytest.raises(UserError) as refused:
        scene(SceneVehicle(0.0, 0), car)
    assert what in str(refused.value)


def test_bodies_side_by_side_in_two_lanes_are_no_overlap():
    scene(SceneVehicle(0.0, 0), SceneVehicle(0.0, 1)).check(ROAD, TABLE_V)


def test_jitter_that_could_make_an_overlap_is_refused():
    pair(3.0, 0.0, 0.0, jitter_m=2.9)  # the ego does not move
    with pytest.raises(UserError, match=r"overlap \(with jitter_m=3\.1 at its worst\)"):
        pair(3.0, 0.0, 0.0, jitter_m=3.1)


def test_a_follower_that_would_need_more_than_the_strongest_braking_is_refused():
    """From 20 m/s to a standing car 9.9 m ahead: 20.2 m/s2; from 11 m: 18.2."""
    with pytest.raises(UserError, match=r"ego at 20 m/s, 9\.9 m behind vehicle 1 at 0 m/s, would need 20\.2 m/s2"):
        pair(9.9, 20.0, 0.0).check(ROAD, TABLE_V)
    pair(11.0, 20.0, 0.0).check(ROAD, TABLE_V)


def test_jitter_is_taken_at_its_worst():
    with pytest.raises(UserError, match="would need"):
        pair(11.0, 20.0, 0.0, jitter_m=1.0, jitter_mps=0.5).check(ROAD, TABLE_V)


def test_who_is_in_another_lane_is_no_leader():
    scene(SceneVehicle(0.0, 0, 30.0), SceneVehicle(6.0, 1, 0.0)).check(ROAD, TABLE_V)


def test_a_lane_change_that_nobody_sees_in_time_is_refused():
    """Seen only once its centre is in the ego's lane; its body is there before. Signalled, it is seen at once."""
    cutter = SceneVehicle(30.0, 1, 8.0, 8.0, target_lane=0, visibility=Visibility.CENTRE)
    hidden = scene(SceneVehicle(0.0, 0, 25.0), cutter)
    scene(SceneVehicle(0.0, 0, 25.0), replace(cutter, visibility=Visibility.SIGNALLED)).check(ROAD, TABLE_V)
    with pytest.raises(UserError, match="the ego and vehicle 1 crash after"):
        hidden.check(ROAD, TABLE_V)


def test_the_road_must_be_the_scenes():
    with pytest.raises(UserError, match="2 lanes of 4 m, the traffic's has 3"):
        pair(50.0, 10.0, 10.0).check(Road(3), TABLE_V)


@settings(max_examples=25)
@given(gap=st.floats(0.2, 60.0), speed=st.floats(0.0, 40.0), leader=st.floats(0.0, 40.0))
def test_a_pair_is_refused_exactly_where_it_cannot_brake(gap, speed, leader):
    closing = max(speed - leader, 0.0)
    hopeless = closing * closing / (2.0 * gap) > -TABLE_V.min_acceleration
    if hopeless:
        with pytest.raises(UserError, match="would need"):
            pair(gap, speed, leader).check(ROAD, TABLE_V)
    elif closing * (closing + 2.0) / (2.0 * gap) < -0.9 * TABLE_V.min_acceleration:
        pair(gap, speed, leader).check(ROAD, TABLE_V)


# Files

CSV = """# cut in
x_m, lane, speed_mps, desired_speed_mps, target_lane, visibility
10, 0, 20, 25, ,
50, 1, 18, 18, 0, body
-40, 0, 20, , , signalled
"""


def test_a_scene_is_read_from_csv_and_from_json_alike(tmp_path):
    (tmp_path / "a.csv").write_text(CSV)
    cars = [
        {"x_m": 10, "lane": 0, "speed_mps": 20, "desired_speed_mps": 25},
        {"x_m": 50, "lane": 1, "speed_mps": 18, "desired_speed_mps": 18, "target_lane": 0, "visibility": "body"},
        {"x_m": -40, "lane": 0, "speed_mps": 20, "visibility": "signalled"},
    ]
    (tmp_path / "a.json").write_text(json.dumps({"lanes": 2, "vehicles": cars}))
    from_csv, from_json = read_scene(tmp_path / "a.csv"), read_scene(tmp_path / "a.json")
    assert from_csv.rows == from_json.rows
    assert from_csv.road == from_json.road == Road(2)
    assert from_csv.rows[1] == SceneVehicle(50.0, 1, 18.0, 18.0, target_lane=0, visibility=Visibility.BODY)
    assert from_csv.label(1) == "vehicle 1 (line 4)"
    assert read_scene(tmp_path / "a.csv", lanes=3).road.lanes == 3


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ("", "empty"),
        ("x_m,lane\n0,0\n", "1 vehicles; a scene needs the ego and at least one other"),
        ("x_m,speed_mps\n0,1\n", "line 1: columns x_m and lane (or y_m) are needed"),
        ("x_m,lane,sped\n0,0,1\n", "line 1: unknown column 'sped'"),
        ("x_m,lane,lane\n0,0,1\n", "line 1: column lane is given twice"),
        ("x_m,lane\n0,0\n30\n", "line 3: 1 cells, the header has 2"),
        ("x_m,lane\n0,0\n\nfar,0\n", "line 4: column x_m: 'far': expected a number"),
        ("x_m,lane\n0,0\n30,0.5\n", "line 3: column lane: '0.5': expected a whole number"),
        ("x_m,lane,visibility\n0,0,\n30,0,bright\n", "line 3: column visibility: 'bright': expected one of centre"),
        ("x_m,lane\n0,0\n3,0\n", "the ego (line 2) and vehicle 1 (line 3) overlap"),
        ("x_m,lane\n0,0\ninf,0\n", "vehicle 1 (line 3): x_m=inf: expected a number from -1e+06 to 1e+06"),
    ],
)
def test_a_fault_in_a_csv_file_is_named_by_line_and_column(tmp_path, content, what):
    path = tmp_path / "a.csv"
    path.write_text(content)
    with pytest.raises(UserError) as refused:
        read_scene(path)
    assert what in str(refused.value)
    assert str(path) in str(refused.value)


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ("[{", "not JSON"),
        ("3", "expected a list of vehicles"),
        ('{"cars": []}', "expected a list of vehicles"),
        ('{"lanes": 0, "vehicles": []}', "lanes=0: expected a finite number above 0"),
        ('{"roads": 1, "vehicles": []}', "unknown key 'roads'"),
        ("[[1, 2]]", "vehicles entry 1: expected an object"),
        ('[{"x_m": 0, "lane": 0}, {"lane": 0}]', "vehicles entry 2: column x_m: no value"),
        ('[{"x_m": 0, "lane": true}]', "vehicles entry 1: column lane: True: expected a whole number"),
    ],
)
def test_a_fault_in_a_json_file_is_named_by_entry_and_column(tmp_path, content, what):
    path = tmp_path / "a.json"
    path.write_text(content)
    with pytest.raises(UserError) as refused:
        read_scene(path)
    assert what in str(refused.value)


def test_other_files_are_refused(tmp_path):
    with pytest.raises(UserError, match="no such file"):
        read_scene(tmp_path / "none.csv")
    (tmp_path / "a.yaml").write_text("x")
    with pytest.raises(UserError, match=r"expected a scene as \.csv or \.json"):
        read_scene(tmp_path / "a.yaml")
    (tmp_path / "a.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match="not a text file"):
        read_scene(Path(tmp_path / "a.csv"))
    (tmp_path / "b.json").write_text('{"lanes": 2, "vehicles": []}')
    with pytest.raises(UserError, match="lanes is 2 in the file and 3 was asked for"):
        read_scene(tmp_path / "b.json", lanes=3)
