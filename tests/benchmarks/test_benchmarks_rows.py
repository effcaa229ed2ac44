"""Rows, ratios and exponents against figures worked out by hand."""

from __future__ import annotations

import pytest

from ganlane.benchmarks.case import Labels
from ganlane.benchmarks.rows import exponent, make_row, spread
from ganlane.benchmarks.tables import Table, count, percent, significant
from ganlane.benchmarks.timing import Sample

LABELS = Labels("sim", "speed", "mine", "idm", "eager", "float32", "cpu", 1, 9, 3, 4)


def test_a_row_holds_medians_over_the_turns():
    samples = [Sample(wall_s, 2 * wall_s, 40, 400) for wall_s in (1.0, 4.0, 2.0)]
    row = make_row(LABELS, samples)
    assert (row["physics_steps_per_s"], row["decisions_per_s"]) == (200, 20)
    assert row["vehicle_steps_per_s"] == 9 * 200
    assert row["physics_steps_per_cpu_s"] == 100
    assert (row["wall_s"], row["cpu_s"], row["decisions"], row["repetitions"]) == (2, 4, 40, 3)
    assert (row["ratio"], row["ratio_cpu"], row["peak_memory_mb"]) == (None, None, None)
    assert (row["system"], row["batch"]) == ("mine", 4)


def test_a_ratio_compares_turns_of_the_same_round():
    # Both are ten times slower in the second round, when the machine was busy: the ratio does not see it.
    mine = [Sample(1.0, 1.0, 1, 300), Sample(10.0, 1.0, 1, 300), Sample(1.0, 1.0, 1, 300)]
    peer = [Sample(1.0, 0.5, 1, 10), Sample(10.0, 0.5, 1, 10), Sample(1.0, 0.5, 1, 10)]
    row = make_row(LABELS, mine, peer)
    assert row["ratio"] == pytest.approx(30)
    assert row["ratio_cpu"] == pytest.approx(15)


def test_a_turn_too_short_for_the_cpu_clock_divides_by_no_zero():
    assert make_row(LABELS, [Sample(0.001, 0.0, 1, 10)])["physics_steps_per_cpu_s"] > 0


def test_spread_is_the_interquartile_range_over_the_median():
    assert spread([1, 2, 3, 4, 5]) == pytest.approx(2 / 3)
    assert spread([7]) == 0


@pytest.mark.parametrize("power", [0.0, 1.0, 1.7])
def test_the_exponent_of_a_power_law_is_its_power(power):
    sizes = [9, 15, 30, 60]
    assert exponent(sizes, [0.3 * size**power for size in sizes]) == pytest.approx(power, abs=1e-9)


def test_one_size_has_no_exponent():
    assert exponent([9, 9], [1.0, 2.0]) is None


@pytest.mark.parametrize(
    ("value", "shown"),
    [(None, "-"), (612.4, "612"), (1234, "1.23 k"), (54321, "54.3 k"), (999_600, "1.00 M"), (2.5e9, "2.50 G")],
)
def test_counts_have_three_digits_and_a_unit(value, shown):
    assert count(value) == shown


@pytest.mark.parametrize(
    ("value", "shown"),
    [(1.0, "1.00"), (0.9134, "0.913"), (12.345, "12.3"), (1234.5, "1230"), (0.0, "0"), (None, "-")],
)
def test_numbers_have_three_digits(value, shown):
    assert significant(value) == shown


def test_a_table_aligns_words_left_and_numbers_right():
    table = Table("Speed", ["who", "n"], [["a", "10"], ["long", "2"]], notes=["Said."])
    assert table.text().splitlines()[2:] == ["who    n", "----  --", "a     10", "long   2", "Said."]
    assert "| --- | ---: |" in table.markdown()
    assert table.markdown().startswith("### Speed\n\n| who | n |")
    assert percent(0.126) == "13 %"
