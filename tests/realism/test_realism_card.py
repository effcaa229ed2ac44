"""The rows of a card."""

from ganlane.data import SyntheticTraffic, scene_lane_widths, synthetic_scenes
from ganlane.evaluation.realism.card import quantity_rows
from ganlane.evaluation.realism.distances import ceiling
from ganlane.evaluation.realism.drivers import ConstantVelocity, RandomDriving
from ganlane.evaluation.realism.driving import drive, measure_recordings
from ganlane.evaluation.realism.quantities import QUANTITIES
from ganlane.evaluation.realism.recordings import recordings_of
from ganlane.evaluation.realism.simulation import StartOptions

WITHOUT_CHANGES = [name for name in QUANTITIES if name != "lane_change_duration"]


def test_a_card_puts_the_model_between_its_ceiling_and_its_floors():
    frame = synthetic_scenes(SyntheticTraffic(scenes=4, vehicles=10, seconds=8.0, speed_swing_mps=0.2))
    recordings = recordings_of(frame, scene_lane_widths(frame))
    units = [each.name for each in recordings]
    measured = measure_recordings(recordings)
    recorded = {name: measured.counts(units, name) for name in QUANTITIES}
    makers = {"cruise": ConstantVelocity, "random": RandomDriving, "constant_velocity": ConstantVelocity}
    driven = {name: drive(make, recordings, StartOptions()) for name, make in makers.items()}
    own = driven.pop("cruise")
    rows = quantity_rows(own, {**driven, "rival": driven["random"]}, recorded, {}, resamples=100)
    assert rows["speed"]["distance"] == rows["speed"]["constant_velocity"] < rows["speed"]["floor"]
    assert rows["acceleration"]["against"]["rival"]["verdict"] == "closer"
    assert rows["speed"]["against"].keys() == {"rival"}
    assert all(rows[name]["samples"] > 0 for name in WITHOUT_CHANGES)
    assert all(rows[name]["ceiling"] == ceiling(recorded[name]) for name in WITHOUT_CHANGES)


def test_floors_that_were_not_driven_are_those_that_were_measured_before():
    frame = synthetic_scenes(SyntheticTraffic(scenes=2, vehicles=6, seconds=6.0))
    recordings = recordings_of(frame, scene_lane_widths(frame))
    own, measured = drive(ConstantVelocity, recordings, StartOptions()), measure_recordings(recordings)
    recorded = {"speed": measured.counts([each.name for each in recordings], "speed")}
    rows = quantity_rows(own, {}, recorded, {"random": {"speed": 0.5}}, resamples=100)
    assert rows.keys() == {"speed"}
    assert rows["speed"]["floor"] == 0.5
    assert rows["speed"]["constant_velocity"] is None
