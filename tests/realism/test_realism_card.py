"""The rows and checks of a card."""

from reference.recordings import recorded_cars

from ganlane.realism.card import card_checks, quantity_rows
from ganlane.realism.driving import ConstantVelocity, RandomDriving, StartOptions
from ganlane.realism.long_runs import LongRunParameters, long_run
from ganlane.realism.measures import QUANTITIES, ceiling, measure_recordings
from ganlane.realism.starts import simulate
from ganlane.sim.state import Road
from ganlane.traffic import IdmTraffic

WITHOUT_CHANGES = [name for name in QUANTITIES if name != "lane_change_duration"]


def test_a_card_puts_the_model_between_its_ceiling_and_its_floors():
    recordings = recorded_cars(scenes=4, vehicles=10, seconds=8.0, speed_swing_mps=0.2)
    recorded = measure_recordings(recordings).counts
    makers = {"cruise": ConstantVelocity, "random": RandomDriving, "constant_velocity": ConstantVelocity}
    driven = {name: simulate(make, recordings, StartOptions()) for name, make in makers.items()}
    rows = quantity_rows("cruise", {**driven, "rival": driven["random"]}, recorded, {}, resamples=100)
    assert rows["speed"]["distance"] == rows["speed"]["constant_velocity"] < rows["speed"]["floor"]
    assert rows["acceleration"]["against"]["rival"]["verdict"] == "closer"
    assert rows["speed"]["against"].keys() == {"rival"}
    assert all(rows[name]["samples"] > 0 for name in WITHOUT_CHANGES)
    assert all(rows[name]["ceiling"] == ceiling(recorded[name]) for name in WITHOUT_CHANGES)


def test_floors_that_were_not_driven_are_those_that_were_measured_before():
    recordings = recorded_cars(scenes=2, vehicles=6, seconds=6.0)
    own = simulate(ConstantVelocity, recordings, StartOptions())
    recorded = {"speed": measure_recordings(recordings).counts["speed"]}
    rows = quantity_rows("cruise", {"cruise": own}, recorded, {"random": {"speed": 0.5}}, resamples=100)
    assert rows.keys() == {"speed"}
    assert rows["speed"]["floor"] == 0.5
    assert rows["speed"]["constant_velocity"] is None


def test_checks_hold_runs_against_the_recordings():
    run = long_run(IdmTraffic, Road(), LongRunParameters(vehicles=6, vehicle_km=1.0, most_s=20.0))
    quantities = {
        name: {"against": {"rival": {"verdict": "closer"}}}
        for name in ("speed_spread", "acceleration", "time_headway", "time_to_collision", "lane_change_duration")
    }
    quantiles = [{"acceleration": {"0.05": low, "0.95": 1.0}} for low in (-1.0, -1.2)]
    checks = card_checks(quantities, *quantiles, [0.7, 1.2], 2.8, [run])
    assert checks["acceleration_quantiles_within_30_percent"] is True
    assert checks["compared_with"]["rival"]["acceleration"] == "closer"
    (of_run,) = checks["long_runs"]
    assert of_run["nobody_off_the_road"] is of_run["overlaps_under_1_per_1000_vehicle_km"] is True
    assert of_run["lane_changes_inside_recorded_interval"] is False
    assert of_run["guard_under_5_percent"] is None
    far = {"acceleration": {"0.05": -2.0, "0.95": 1.0}}
    checks = card_checks(quantities, quantiles[0], far, None, 2.8, [run])
    assert checks["acceleration_quantiles_within_30_percent"] is False
    assert checks["long_runs"][0]["lane_changes_inside_recorded_interval"] is None
