"""The shipped histograms."""

import json
from dataclasses import replace

import numpy as np
import pytest
from reference.recordings import recorded_cars

from ganlane.data import default_scenes, read_scenes, scene_lane_widths
from ganlane.errors import UserError
from ganlane.realism.measures import QUANTITIES, SHIPPED_REFERENCE, Reference, ceiling, measure_recordings
from ganlane.realism.recordings import recordings_of


@pytest.fixture
def reference():
    recordings = recorded_cars(scenes=3)
    whole = {"lane_changes": 3, "vehicle_km": 2.0, "speed_spread_mps": 1.0}
    floors = {"random": {"speed": 0.5}, "constant_velocity": {"speed": 0.2}}
    names = [each.name for each in recordings]
    return replace(Reference.of(measure_recordings(recordings), names, whole, "made up"), floors=floors)


def test_a_reference_comes_back_from_its_file(reference, tmp_path):
    path = tmp_path / "reference.json"
    reference.save(path)
    again = Reference.load(path)
    for name in QUANTITIES:
        assert np.array_equal(again.counts[name], reference.counts[name])
    assert {**vars(again), "counts": 0} == {**vars(reference), "counts": 0}
    assert json.loads(path.read_text())["ceilings"].keys() == QUANTITIES.keys()


@pytest.mark.parametrize("damage", ["absent", "text", "kind", "bins"])
def test_another_file_is_refused_in_a_sentence(damage, reference, tmp_path):
    path = tmp_path / "reference.json"
    if damage != "absent":
        reference.save(path)
        numbers = json.loads(path.read_text())
        del numbers["checksum"]  # that of another content
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
        assert ceiling(shipped.counts[name]) < shipped.floors["random"][name]
    assert all(0.0 < ceiling(shipped.counts[name]) < 1.0 for name in QUANTITIES)


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
        assert np.array_equal(measured.counts[name], shipped.counts[name])
    low, high = (shipped.quantiles["acceleration"][level] for level in ("0.05", "0.95"))
    # Published with the recordings, all of every track: -1.2 and 1.4.
    assert (low, high) == pytest.approx((-1.2, 1.4), abs=0.05)
