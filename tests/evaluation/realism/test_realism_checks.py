"""What a card is looked at for first."""

from ganlane.evaluation.realism.checks import card_checks
from ganlane.evaluation.realism.long import LongRunParameters, long_run
from ganlane.sim.road import Road
from ganlane.traffic import IdmTraffic


def test_checks_hold_runs_against_the_recordings():
    run = long_run(IdmTraffic, Road(), LongRunParameters(vehicles=6, vehicle_km=1.0, most_s=20.0))
    quantities = {
        name: {"against": {"rival": {"verdict": "closer"}}}
        for name in ("speed_spread", "acceleration", "time_headway", "time_to_collision", "lane_change_duration")
    }
    quantiles = [{"acceleration": {"0.05": low, "0.95": 1.0}} for low in (-1.0, -1.2)]
    rate = {"per_vehicle_km_ci": [0.7, 1.2]}
    checks = card_checks(quantities, *quantiles, rate, 2.8, [run])
    assert checks["acceleration_quantiles_within_30_percent"] is True
    assert checks["compared_with"]["rival"]["acceleration"] == "closer"
    (told,) = checks["long_runs"]
    assert told["nobody_off_the_road"] is told["overlaps_under_1_per_1000_vehicle_km"] is True
    assert told["lane_changes_inside_recorded_interval"] is False
    assert told["guard_under_5_percent"] is None
    assert (
        card_checks(quantities, quantiles[0], {"acceleration": {"0.05": -2.0, "0.95": 1.0}}, rate, 2.8, [])[
            "acceleration_quantiles_within_30_percent"
        ]
        is False
    )
