"""A card as text and figures."""

import numpy as np
import pytest
from matplotlib.colors import to_hex

from ganlane.realism.card import card_checks
from ganlane.realism.driving import ConstantVelocity
from ganlane.realism.long_runs import LongRunParameters, long_run, totals
from ganlane.realism.measures import QUANTITIES
from ganlane.realism.output import checks_text, draw_distances, draw_distributions, draw_speeds_over_time, long_table
from ganlane.sim.state import Road
from ganlane.traffic.presets import gan_calibrated_traffic, gan_traffic
from ganlane.view.figures import COLOURS, INK

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


def checked(run, rate=(0.7, 1.2)):
    return card_checks(ROWS, QUANTILES, QUANTILES, rate, 2.8, [run])


def test_traffic_that_stands_still_has_counts_and_no_rates():
    run = long_run(Still, Road(), LongRunParameters(vehicles=4, vehicle_km=1.0, most_s=10.0))
    assert run["vehicle_km"] == 0.0
    assert run["standstills_in_free_flow"] > 0
    for name in ("lane_changes_per_vehicle_km", "overlaps_per_1000_vehicle_km"):
        assert run[name] is run[f"{name}_ci"] is totals([run])[name] is totals([run])[f"{name}_ci"] is None
    table = long_table([run], "still")
    assert cells(table, "changes per vehicle-km") == cells(table, "overlaps per 1000 vehicle-km") == ["-"]
    (checks,) = checked(run)["long_runs"]
    assert checks["lane_changes_inside_recorded_interval"] is None
    assert checks["overlaps_under_1_per_1000_vehicle_km"] is None
    assert checks["nobody_standing_in_free_flow"] is False
    assert "lane changes inside recorded interval: unknown" in checks_text(checked(run))


def test_a_traffic_without_a_guard_has_none_in_its_card():
    short = LongRunParameters(vehicles=4, vehicle_km=0.1, most_s=10.0)
    without, with_guard = (long_run(make, Road(), short) for make in (gan_calibrated_traffic, gan_traffic))
    assert (without["guard_share"], without["overlaps"]) == (None, 0)
    assert 0.0 < with_guard["guard_share"] < 1.0
    assert long_run(lambda road: gan_traffic(road, guard=False), Road(), short)["guard_share"] is None
    assert cells(long_table([without], "a"), "the guard's share") == ["none"]
    assert cells(long_table([with_guard], "a"), "the guard's share")[1] == "%"
    assert "guard under 5 percent: no guard" in checks_text(checked(without))
    assert "no guard" not in checks_text(checked(with_guard))


def in_colour(axes, colour):
    return [line for line in axes.lines if to_hex(line.get_color()) == colour]


def test_densities_have_area_one_and_the_quantitys_unit():
    counts = np.zeros(QUANTITIES["jerk"].number)
    counts[[0, 1, 49]] = 1, 2, 1
    rule = np.eye(len(counts))[0] * 4
    figure = draw_distributions({"jerk": counts}, {"idm": {"jerk": rule}, "nobody": {"jerk": 0 * rule}})
    (axes,) = figure.axes
    assert (axes.get_title("left"), axes.get_xlabel(), axes.get_ylabel()) == ("jerk", "m/s³", "density, per m/s³")
    (recorded, *ends), (simulated, *left_end) = in_colour(axes, INK), in_colour(axes, COLOURS[0])
    # The bins at the ends hold what lies beyond them, too.
    assert ([mark.get_marker() for mark in ends], [mark.get_marker() for mark in left_end]) == (["<", ">"], ["<"])
    assert recorded.get_xdata()[[0, -1]] == pytest.approx([-4.9, 4.9])
    # A quarter of the samples in a bin of 0.2 m/s3.
    assert recorded.get_ydata()[[0, 1, 2, 49]] == pytest.approx([1.25, 2.5, 0.0, 1.25])
    assert simulated.get_ydata()[:2] == pytest.approx([5.0, 0.0])
    assert in_colour(axes, COLOURS[1]) == []
    assert axes.get_xlim() == (-5.0, 5.0)
    named = [text.get_text() for text in figure.legends[0].get_texts()]
    assert named == ["recorded", "idm", "nobody", "and all values beyond"]


def row(distance, **against):
    scale = {"ceiling": 0.1, "floor": 0.9}
    return {"distance": distance, "distance_ci": [distance - 0.1, distance + 0.1], **scale, "against": against}


def test_every_traffic_has_its_dot_and_interval_at_its_distance():
    rival = {"distance": 0.75, "distance_ci": None}
    figure = draw_distances({"speed": row(0.25, rule=rival), "gap": row(0.4, rule=rival)}, "my.module.Mine")
    (axes,) = figure.axes
    interval, dot, *below = in_colour(axes, COLOURS[0])
    assert interval.get_xdata() == pytest.approx([0.15, 0.35])
    assert dot.get_xdata() == [0.25]
    assert below[1].get_ydata()[0] > dot.get_ydata()[0]
    assert [line.get_xdata()[0] for line in in_colour(axes, COLOURS[1])] == [0.75] * 4
    assert [label.get_text() for label in axes.get_yticklabels()] == ["speed", "gap"]
    assert axes.get_xlim() == (0.0, 1.0)
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["Mine", "rule", "half against half", "random"]


def test_the_ends_of_the_scale_are_upright_lines():
    (axes,) = draw_distances({"speed": row(0.5)}, "mine").axes
    assert [lines.get_segments()[0][:, 0].tolist() for lines in axes.collections] == [[0.1, 0.1], [0.9, 0.9]]


def test_a_quantity_without_a_distance_or_a_scale_has_no_mark():
    nothing = {**row(0.5), "distance": None, "distance_ci": None, "ceiling": None, "floor": None}
    (axes,) = draw_distances({"lane_change_duration": nothing}, "mine").axes
    assert in_colour(axes, COLOURS[0]) == []
    assert len(axes.collections) == 0


def test_drift_is_drawn_over_time_with_a_gap_where_nobody_was_left():
    speeds = {
        "10 s": {"mean_speed_mps": 20.0, "spread_mps": 2.0},
        "60 s": {"mean_speed_mps": None, "spread_mps": None},
        "300 s": {"mean_speed_mps": 22.0, "spread_mps": 3.0},
        "5000 m": {"mean_speed_mps": 21.0, "spread_mps": 2.5},
    }
    figure = draw_speeds_over_time([{"vehicles": 9, "speeds": speeds}], spread_mps=2.8)
    mean, spread = figure.axes
    assert (mean.get_title("left"), mean.get_xlabel(), mean.get_ylabel()) == ("mean speed", "time, s", "m/s")
    (line,) = in_colour(mean, COLOURS[0])
    assert line.get_xdata().tolist() == [10.0, 60.0, 300.0]
    assert line.get_ydata() == pytest.approx([20.0, np.nan, 22.0], nan_ok=True)
    (level,) = in_colour(spread, INK)
    assert set(level.get_ydata()) == {2.8}
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["recorded", "9 vehicles"]
