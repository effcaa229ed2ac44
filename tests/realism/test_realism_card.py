"""The rows of a card; a card as text and figures."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import to_hex
from reference.recordings import recorded_cars

from ganlane.data.dense import units_of
from ganlane.realism.card import card_rows
from ganlane.realism.driving import ConstantVelocity, RandomDriving, StartOptions
from ganlane.realism.long_runs import LongRunParameters, long_run, totals
from ganlane.realism.measures import QUANTITIES, Reference, ceiling, measure
from ganlane.realism.sheets import draw_distributions, long_table
from ganlane.realism.starts import Starts, simulate
from ganlane.sim.state import Road
from ganlane.view.figures import COLOURS, INK


def test_a_card_puts_the_model_between_its_ceiling_and_its_floors_driven_or_measured_before():
    recordings = recorded_cars(scenes=4, vehicles=10, seconds=8.0, speed_swing_mps=0.2)
    measured = measure(recordings)
    recorded = measured.counts
    cruise, random = (
        simulate(make, recordings, StartOptions()) for make in (ConstantVelocity, RandomDriving)
    )
    driven = {"cruise": cruise, "random": random, "constant_velocity": cruise, "rival": random}
    whole = Reference(**vars(measured), source="", units=[], whole={}, floors={})
    starts = Starts(units_of(recordings), [], {}, driven, measured, whole)
    rows = card_rows(starts, 100)
    assert rows["speed"]["distance"] == rows["speed"]["constant_velocity"] < rows["speed"]["floor"]
    assert rows["acceleration"]["against"]["rival"]["verdict"] == "closer"
    assert rows["speed"]["against"].keys() == {"rival"}
    quantities = QUANTITIES.keys() - {"lane_change_duration"}
    assert all(rows[name]["ceiling"] == ceiling(recorded[name]) for name in quantities)
    # Without reference drivers in the run, what was measured before counts.
    speeds = replace(measured, counts={"speed": recorded["speed"]})
    before = replace(whole, floors={"random": {"speed": 0.5}})
    alone = replace(starts, driven={"cruise": cruise}, recorded=speeds, reference=before)
    rows = card_rows(alone, 100)
    assert rows.keys() == {"speed"}
    assert rows["speed"]["floor"] == 0.5
    assert rows["speed"]["constant_velocity"] is None


class Still(ConstantVelocity):
    """Nobody moves."""

    def move(self, vehicles, memory, key, step):
        return vehicles.with_(speed=0.0 * vehicles.speed), memory


def cells(table, row):
    (line,) = [line for line in table.splitlines() if line.startswith(row)]
    return line.removeprefix(row).split()


def test_traffic_that_stands_still_has_counts_and_no_rates():
    run = long_run(Still, Road(), LongRunParameters(vehicles=4, vehicle_km=1.0, most_s=10.0))
    assert run["vehicle_km"] == 0.0
    assert run["standstills_in_free_flow"] > 0
    for rate in ("lane_changes_per_vehicle_km", "overlaps_per_1000_vehicle_km"):
        assert run[rate] is run[f"{rate}_ci"] is totals([run])[rate] is None
    table = long_table([run], "still")
    assert (
        cells(table, "changes per vehicle-km")
        == cells(table, "overlaps per 1000 vehicle-km")
        == ["-"]
    )


def in_colour(axes, colour):
    return [line for line in axes.lines if to_hex(line.get_color()) == colour]


def test_densities_have_area_one_and_the_quantitys_unit():
    counts = np.zeros(QUANTITIES["jerk"].bins)
    # Both outermost bins, and one more.
    counts[[0, 1, 49]] = 1, 2, 1
    rule = np.eye(len(counts))[0] * 4
    figure = draw_distributions(
        {"jerk": counts}, {"idm": {"jerk": rule}, "nobody": {"jerk": 0 * rule}}
    )
    (axes,) = figure.axes
    assert axes.get_ylabel() == "density, per m/s³"
    (recorded, *ends), (simulated, *left_end) = (in_colour(axes, INK), in_colour(axes, COLOURS[0]))
    # The bins at the ends hold what lies beyond them, too.
    assert ([mark.get_marker() for mark in ends], [mark.get_marker() for mark in left_end]) == (
        ["<", ">"],
        ["<"],
    )
    assert recorded.get_xdata()[[0, -1]] == pytest.approx([-4.9, 4.9])
    # A quarter of the samples in a bin of 0.2 m/s3.
    assert recorded.get_ydata()[[0, 1, 2, 49]] == pytest.approx([1.25, 2.5, 0.0, 1.25])
    assert simulated.get_ydata()[:2] == pytest.approx([5.0, 0.0])
    assert in_colour(axes, COLOURS[1]) == []
