"""Turns of cases, the rows that they give, and memory in processes of its own."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial

import pytest
import torch

from ganlane.bench.measure import (
    Case,
    Labels,
    Sample,
    best_rows,
    decisions_per_turn,
    growth_per_environment,
    make_row,
    take_turn,
    take_turns,
    torch_threads,
)
from ganlane.runtime import peak_resident_bytes

LABELS = Labels("sim", "speed", "mine", "idm", "eager", "float32", "cpu", 1, 9, 3, 4)
CASE = Case(LABELS, lambda: lambda decisions: 0)


def napping(seconds=0.002, log=None, name=""):
    """Ten physics steps a decision, each decision a nap."""

    def run(decisions):
        if log is not None:
            log.append(name)
        time.sleep(seconds * decisions)
        return 10 * decisions

    return run


def test_cases_take_turns_after_the_warm_up():
    log = []
    take_turns(
        [CASE, CASE], [napping(log=log, name=name) for name in "AB"], repetitions=3, seconds=0.004
    )
    assert "".join(log[-6:]) == "ABABAB"


def test_a_turn_lasts_as_long_as_asked_and_holds_one_decision_at_least():
    # Naps are never shorter than asked, and on a busy machine longer.
    assert 5 <= decisions_per_turn(CASE, napping(0.002), 0.1) <= 50
    assert decisions_per_turn(CASE, napping(0.02), 0.001) == 1


def test_a_nap_costs_wall_time_but_no_cpu_time():
    sample = take_turn(CASE, napping(0.05), 2)
    assert sample.wall_s >= 0.1
    assert sample.cpu_s < 0.05
    assert (sample.decisions, sample.physics_steps) == (8, 20)


def test_torch_gets_its_threads_back():
    before = torch.get_num_threads()
    with torch_threads(before + 1):
        assert torch.get_num_threads() == before + 1
    assert torch.get_num_threads() == before


def test_a_row_holds_medians_over_the_turns():
    row = make_row(LABELS, [Sample(wall_s, 2 * wall_s, 40, 400) for wall_s in (1.0, 4.0, 2.0)])
    assert (row["physics_steps_per_s"], row["decisions_per_s"]) == (200, 20)
    assert row["vehicle_steps_per_s"] == 9 * 200
    assert row["physics_steps_per_cpu_s"] == 100
    assert (row["wall_s"], row["cpu_s"], row["decisions"], row["repetitions"]) == (2, 4, 40, 3)
    assert (row["ratio"], row["ratio_cpu"], row["peak_memory_mb"]) == (None, None, None)
    assert (row["system"], row["batch"]) == ("mine", 4)


def test_spread_is_the_interquartile_range_over_the_median():
    assert make_row(LABELS, [Sample(s, 1.0, 1, 1) for s in (1, 2, 3, 4, 5)])[
        "spread"
    ] == pytest.approx(2 / 3)
    assert make_row(LABELS, [Sample(7, 1.0, 1, 1)])["spread"] == 0


def test_a_ratio_compares_turns_of_the_same_round():
    # Both are ten times slower in the second round, when the machine was busy: the ratio does not
    # see it.
    mine, peer = (
        [Sample(wall_s, *each) for wall_s in (1.0, 10.0, 1.0)]
        for each in ((1.0, 1, 300), (0.5, 1, 10))
    )
    row = make_row(LABELS, mine, peer)
    assert (row["ratio"], row["ratio_cpu"]) == pytest.approx((30, 15))


def test_a_turn_too_short_for_the_cpu_clock_divides_by_no_zero():
    assert make_row(LABELS, [Sample(0.001, 0.0, 1, 10)])["physics_steps_per_cpu_s"] > 0


def test_the_best_row_is_that_of_each_system_and_traffic_on_each_device():
    found = [
        ("a", "idm", "cpu", 1),
        ("a", "idm", "cpu", 3),
        ("a", "idm", "cuda", 9),
        ("a", "gan", "cpu", 2),
    ]
    rows = [
        dict(zip(("system", "traffic", "device", "n"), each))
        for each in (*found, ("b", "idm", "cpu", 0))
    ]
    assert [row["n"] for row in best_rows(rows, "n")] == [3, 9, 2, 0]


def hold(batch):
    """Holds 100 kB per environment, and writes to all of it."""
    held = torch.ones(batch, 25_000)
    return lambda decisions: 10 * decisions * len(held.mul_(1.0))


@pytest.mark.slow
def test_growth_finds_what_an_environment_holds():
    if peak_resident_bytes() is None:
        pytest.skip("this system does not report a process's peak memory")
    small, large = (
        Case(replace(LABELS, batch=batch), partial(hold, batch)) for batch in (400, 2400)
    )
    # 40 to 240 MB, of which the rest of the process moves by a few.
    assert growth_per_environment(small, large) == pytest.approx(4 * 25_000, rel=0.05)
