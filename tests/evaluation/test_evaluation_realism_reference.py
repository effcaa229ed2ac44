"""The shipped histograms, and the I-80 files."""

import json

import numpy as np
import polars as pl
import pytest

from ganlane.data import SyntheticTraffic, default_scenes, read_scenes, scene_lane_widths, synthetic_scenes
from ganlane.errors import UserError
from ganlane.evaluation.realism_card import measure_recordings
from ganlane.evaluation.realism_i80 import FILES, i80_files, read_i80
from ganlane.evaluation.realism_quantities import QUANTITIES
from ganlane.evaluation.realism_recordings import recordings_of
from ganlane.evaluation.realism_reference import SHIPPED_REFERENCE, Reference, reference_of


@pytest.fixture
def reference():
    frame = synthetic_scenes(SyntheticTraffic(scenes=3))
    recordings = recordings_of(frame, scene_lane_widths(frame))
    whole = {"lane_changes": 3, "vehicle_km": 2.0, "speed_spread_mps": 1.0}
    floors = {"random": {"speed": 0.5}, "constant_velocity": {"speed": 0.2}}
    names = [each.name for each in recordings]
    return reference_of(measure_recordings(recordings), names, whole, "made up", floors)


def test_a_reference_comes_back_from_its_file(reference, tmp_path):
    path = tmp_path / "reference.json"
    reference.save(path)
    again = Reference.load(path)
    for name in QUANTITIES:
        assert np.array_equal(again.counts[name], reference.counts[name])
    assert {**vars(again), "counts": 0} == {**vars(reference), "counts": 0}
    assert again.ceilings.keys() == QUANTITIES.keys()


@pytest.mark.parametrize("damage", ["absent", "text", "kind", "bins"])
def test_another_file_is_refused_in_a_sentence(damage, reference, tmp_path):
    path = tmp_path / "reference.json"
    if damage != "absent":
        reference.save(path)
        numbers = json.loads(path.read_text())
        numbers |= {"kind": {"kind": "a recipe"}, "bins": {"bins": {}}}.get(damage, {})
        path.write_text("{" if damage == "text" else json.dumps(numbers))
    with pytest.raises(UserError, match=r"reference\.json: not the histograms"):
        Reference.load(path)


def test_what_ships_is_small_and_holds_no_trajectories():
    shipped = Reference.load(SHIPPED_REFERENCE)
    assert SHIPPED_REFERENCE.stat().st_size < 200_000
    assert len(shipped.units) == 11
    rate = shipped.rate()
    # Published with the recordings: 57 changes in 61.7 vehicle-km.
    assert rate["lane_changes"] == 57
    assert rate["per_vehicle_km_ci"] == pytest.approx([0.70, 1.20], abs=0.01)
    assert shipped.spread_mps == pytest.approx(2.8, abs=0.05)
    for name in ("acceleration", "jerk", "time_headway", "time_to_collision"):
        assert shipped.ceilings[name] < shipped.floors["random"][name]
    assert all(0.0 < shipped.ceilings[name] < 1.0 for name in QUANTITIES)


def lane_file(path):
    rows = [(car, frame, 20.0 + 1.8 * (frame - 20 * car), 0.0) for car in range(12) for frame in range(20 * car, 320)]
    pl.DataFrame(rows, schema=["vehicle", "frame", "x", "x_raw"], orient="row").write_csv(path)


def pairs_file(path):
    rows = [
        ("2-1", role, number, float(frame), 10.0 + start + 0.9 * frame, None, 9.0, 2, 5.0, 2.0)
        for frame in range(400)
        for role, number, start in (("follower", 2, 0.0), ("leader", 1, 25.0))
    ]
    names = ["pair", "role", "vehicle", "frame", "x", "y_right", "v", "lane", "length", "width"]
    pl.DataFrame(rows, schema=names, orient="row").write_csv(path)


def following_file(path):
    rows = [("0400pm", 2, 1, frame, 0.7 * frame, 0.7 * frame + 16.0, 6.0) for frame in range(200)]
    names = ["period", "follower", "leader", "frame", "x_follower", "x_leader", "leader_length"]
    pl.DataFrame(rows, schema=names, orient="row").write_csv(path)


def test_pairs_have_a_driven_follower_at_the_recorded_gap(tmp_path):
    for name, write, gap, speed in (("pairs", pairs_file, 20.0, 9.0), ("following", following_file, 10.0, 7.0)):
        write(tmp_path / FILES[name])
        recordings = read_i80(name, tmp_path / FILES[name])
        # 40 s and 20 s, less the first 3, in pieces of 15.
        assert len(recordings) == {"pairs": 2, "following": 1}[name]
        assert {each.lanes for each in recordings} == {1}
        assert all(each.driven.sum() == 1 for each in recordings)
        measured = measure_recordings(recordings)
        assert measured.quantile("gap", 0.5) == pytest.approx(gap, abs=1e-6)
        assert measured.quantile("speed", 0.5) == pytest.approx(speed, abs=1e-6)
        assert recordings[0].speed[recordings[0].present] == pytest.approx(speed)


def test_a_lane_is_driven_as_a_whole_in_stretches_of_their_own(tmp_path):
    lane_file(tmp_path / FILES["lane_1"])
    recordings = read_i80("lane_1", tmp_path / FILES["lane_1"])
    assert len({each.unit for each in recordings}) == len(recordings) == 2
    assert all(each.driven.all() for each in recordings)
    # 2 s apart at 18 m/s, cars of 4.5 m.
    assert measure_recordings(recordings).quantile("gap", 0.5) == pytest.approx(31.5, abs=1e-6)


def test_only_files_that_are_there_are_taken_and_damaged_ones_named(tmp_path):
    following_file(tmp_path / FILES["following"])
    assert list(i80_files(tmp_path)) == ["following"]
    path = tmp_path / FILES["lane_1"]
    path.write_text("vehicle,frame,x\n1,2,three\n")
    with pytest.raises(UserError, match="line 2, column x"):
        read_i80("lane_1", path)
    path.write_text("vehicle,frame,x\n1,2,3.0\n1,3,4.0\n")
    with pytest.raises(UserError, match="nothing in it lasts 15 s"):
        read_i80("lane_1", path)


def test_what_ships_is_what_the_recordings_show():
    try:
        path = default_scenes()
    except UserError as missing:
        pytest.skip(str(missing))
    frame = read_scenes(path)
    recordings = recordings_of(frame, scene_lane_widths(frame))
    measured, shipped = measure_recordings(recordings), Reference.load(SHIPPED_REFERENCE)
    assert shipped.units == [each.name for each in recordings]
    for name in QUANTITIES:
        assert np.array_equal(measured.counts(shipped.units, name), shipped.counts[name])
    low, high = (shipped.quantiles["acceleration"][level] for level in ("0.05", "0.95"))
    # Published with the recordings, all of every track: -1.2 and 1.4.
    assert (low, high) == pytest.approx((-1.2, 1.4), abs=0.05)
