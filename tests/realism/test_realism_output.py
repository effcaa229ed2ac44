"""The card as text."""

from ganlane.realism.card import card_checks
from ganlane.realism.long_runs import LongRunParameters, long_run, totals
from ganlane.realism.output import checks_text, long_table
from ganlane.realism.references import ConstantVelocity
from ganlane.sim.state import Road
from ganlane.traffic.presets import gan_calibrated_traffic, gan_traffic

ROWS = {
    name: {"against": {}}
    for name in ("speed_spread", "acceleration", "time_headway", "time_to_collision", "lane_change_duration")
}
QUANTILES = {"acceleration": {"0.05": -1.0, "0.95": 1.0}}


class Still(ConstantVelocity):
    """Nobody moves."""

    def move(self, vehicles, memory, key, step):
        return vehicles.with_(speed=0.0 * vehicles.speed), memory


def cells(table, row):
    (line,) = [line for line in table.splitlines() if line.startswith(row)]
    return line.removeprefix(row).split()


def told(run, rate=(0.7, 1.2)):
    return card_checks(ROWS, QUANTILES, QUANTILES, {"per_vehicle_km_ci": rate and list(rate)}, 2.8, [run])


def test_traffic_that_stands_still_has_counts_and_no_rates():
    run = long_run(Still, Road(), LongRunParameters(vehicles=4, vehicle_km=1.0, most_s=10.0))
    assert run["vehicle_km"] == 0.0
    assert run["standstills_in_free_flow"] > 0
    for name in ("lane_changes_per_vehicle_km", "overlaps_per_1000_vehicle_km"):
        assert run[name] is run[f"{name}_ci"] is totals([run])[name] is totals([run])[f"{name}_ci"] is None
    table = long_table([run], "still")
    assert cells(table, "changes per vehicle-km") == cells(table, "overlaps per 1000 vehicle-km") == ["-"]
    (checks,) = told(run)["long_runs"]
    assert checks["lane_changes_inside_recorded_interval"] is None
    assert checks["overlaps_under_1_per_1000_vehicle_km"] is None
    assert checks["nobody_standing_in_free_flow"] is False
    assert "lane changes inside recorded interval: not told" in checks_text(told(run))


def test_nothing_is_told_of_lane_changes_where_no_rate_was_recorded():
    run = long_run(ConstantVelocity, Road(), LongRunParameters(vehicles=4, vehicle_km=0.2, most_s=10.0))
    assert told(run, rate=None)["long_runs"][0]["lane_changes_inside_recorded_interval"] is None


def test_a_traffic_without_a_guard_has_none_in_its_card():
    short = LongRunParameters(vehicles=4, vehicle_km=0.1, most_s=10.0)
    without, with_guard = (long_run(make, Road(), short) for make in (gan_calibrated_traffic, gan_traffic))
    assert cells(long_table([without], "a"), "the guard's share") == ["none"]
    assert cells(long_table([with_guard], "a"), "the guard's share")[1] == "%"
    assert "guard under 5 percent: no guard" in checks_text(told(without))
    assert "no guard" not in checks_text(told(with_guard))
