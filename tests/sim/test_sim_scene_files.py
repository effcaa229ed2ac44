"""Scenes from files; what drivers do in the scenarios stands in tests/test_env_scenarios.py."""

import json
import re

import pytest
from reference.refusals import user_error

from ganlane.settings.driving import Visibility
from ganlane.settings.road import EXIT, WALL, LaneStretch
from ganlane.sim.scene_files import read_roads, read_scene
from ganlane.sim.scenes import SceneVehicle
from ganlane.sim.state import Road

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
        {"x_m": 50, "lane": 1, "speed_mps": 18, "desired_speed_mps": 18, "target_lane": 0}
        | {"visibility": "body"},
        {"x_m": -40, "lane": 0, "speed_mps": 20, "visibility": "signalled"},
    ]
    (tmp_path / "a.json").write_text(json.dumps({"lanes": 2, "vehicles": cars}))
    from_csv = read_scene(tmp_path / "a.csv")
    from_json = read_scene(tmp_path / "a.json")
    assert from_csv.rows == from_json.rows
    assert from_csv.road == from_json.road == Road(2)
    assert from_csv.rows[1] == SceneVehicle(
        50.0, 1, 18.0, 18.0, target_lane=0, visibility=Visibility.BODY
    )
    assert from_csv.label(1) == "vehicle 1 (line 4)"
    assert read_scene(tmp_path / "a.csv", lanes=3).road.lanes == 3


#: What a file holds (None: there is none), and what is said of it.
CSV_FAULTS = [
    ("", "empty"),
    ("x_m,lane\n0,0\n", "1 vehicles; a scene needs the ego and at least one other"),
    ("x_m,speed_mps\n0,1\n", "line 1: columns x_m and lane (or y_m) are needed"),
    ("x_m,lane,sped\n0,0,1\n", "line 1: unknown column 'sped'"),
    ("x_m,lane,lane\n0,0,1\n", "line 1: column lane is given twice"),
    ("x_m,lane\n0,0\n30\n", "line 3: 1 cells, the header has 2"),
    ("x_m,lane\n0,0\n\nfar,0\n", "line 4: x_m=far: expected a number"),
    ("x_m,lane\n0,0\n30,0.5\n", "line 3: lane=0.5: expected a whole number"),
    (
        "x_m,lane,visibility\n0,0,\n3,0,bad\n",
        "line 3: visibility=bad: expected one of centre",
    ),
    ("x_m,lane\n0,0\n3,0\n", "the ego (line 2) and vehicle 1 (line 3) overlap"),
    (
        "x_m,lane\n0,0\ninf,0\n",
        "vehicle 1 (line 3): x_m=inf: expected a number from -1e+06 to 1e+06",
    ),
    (b"\xff\xfe\x00", "not a text file"),
    ("x_m,lane\n0,0\n9,1e300\n", "a road of 1e+300 lanes of 4 m; expected 1 to 100"),
    ("x_m,lane\n" + "0,0\n" * 200_000, "a scene has at most 1000"),
    (None, "no such file"),
]
JSON_FAULTS = [
    ("[{", "not JSON"),
    ("3", "expected a list of vehicles"),
    ('{"cars": []}', "expected a list of vehicles"),
    ('{"lanes": 0, "vehicles": []}', "lanes=0: expected at least 1"),
    ('{"roads": 1, "vehicles": []}', "roads: no such key"),
    (
        '{"stretches": [{"end": "wal"}], "vehicles": []}',
        "stretches, lane 0: end=wal: expected one of nothing, wall, exit",
    ),
    (
        '{"lanes": 3, "stretches": [{}], "vehicles": []}',
        "stretches of 1 lanes with the ends nothing: expected one for each of the 3 lanes",
    ),
    ("[[1, 2]]", "vehicles entry 1: expected an object"),
    ('[{"x_m": 0, "lane": 0}, {"lane": 0}]', "vehicles entry 2: x_m: no value"),
    ('[{"x_m": 0, "lane": true}]', "vehicles entry 1: lane=true: expected a whole number"),
    ('{"lanes": 2, "vehicles": []}', "lanes is 2 in the file and 3 was asked for"),
    ('{"lanes": "many", "vehicles": []}', "lanes=many: expected a whole number"),
    ('{"vehicles": null}', "expected a list of vehicles"),
    ('["here", "there"]', "vehicles entry 1: expected an object"),
    (
        '[{"x_m": 0, "lane": 0, "visibility": [1]}]',
        "visibility=[1]: expected one of centre",
    ),
    ('[{"x_m": 1' + "0" * 4000 + ', "lane": 0}]', "vehicles entry 1: x_m=1000000000000"),
]


@pytest.mark.parametrize(
    ("name", "content", "what"),
    [
        *(("a.csv", *fault) for fault in CSV_FAULTS),
        *(("a.json", *fault) for fault in JSON_FAULTS),
        ("a.yaml", "x", "expected a scene as .csv or .json"),
    ],
)
def test_a_fault_in_a_file_is_named_by_line_or_entry_and_column(tmp_path, name, content, what):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with user_error(re.escape(str(path)) + ".*" + re.escape(what)):
        read_scene(path, lanes=3 if "asked for" in what else None)


def test_the_lanes_of_a_scene_begin_and_end_where_its_file_says_seen_from_the_ego(tmp_path):
    content = {
        "stretches": [{"begin_m": 110, "end_m": 360, "end": "wall"}, {}],
        "vehicles": [{"x_m": 10, "lane": 0}, {"x_m": 60, "lane": 1}],
    }
    (tmp_path / "ramp.json").write_text(json.dumps(content))
    road = read_scene(tmp_path / "ramp.json").road
    assert road == Road(2, stretches=(LaneStretch(100.0, 350.0, WALL), LaneStretch()))


def test_the_roads_of_recorded_scenes_are_read(tmp_path):
    file = tmp_path / "roads.json"
    file.write_text('{"a": [{"end_m": 200, "end": "exit"}, {}], "b": [{}]}')
    assert read_roads(file) == {
        "a": (LaneStretch(end_m=200.0, end=EXIT), LaneStretch()),
        "b": (LaneStretch(),),
    }


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ("[]", "expected an object of scenes"),
        ('{"a": {}}', "a: expected a list with an object for each lane"),
        ('{"a": []}', "a: expected a list with an object for each lane"),
        ('{"a": [3]}', "a, lane 0: "),
        ('{"a": [{}, {"end_m": 20}]}', "a, lane 1: end=nothing: expected wall or exit"),
    ],
)
def test_a_mistake_in_the_roads_is_named_by_scene_and_lane(tmp_path, content, what):
    file = tmp_path / "roads.json"
    file.write_text(content)
    with user_error(f"roads.json: {what}"):
        read_roads(file)
