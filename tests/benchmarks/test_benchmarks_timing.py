"""Turns of cases: their order, their length, and what the two clocks count."""

from __future__ import annotations

import time

import torch

from ganlane.benchmarks.case import Case, Labels
from ganlane.benchmarks.timing import Budget, decisions_per_turn, take, take_turns, torch_threads


def case(batch=1):
    labels = Labels("sim", "speed", "mine", "idm", "eager", "float32", "cpu", 1, 9, 3, batch)
    return Case(labels, lambda: lambda decisions: 0)


def napping(log=None, name="", seconds=0.002):
    """Ten physics steps a decision, each decision a nap."""

    def run(decisions):
        if log is not None:
            log.append(name)
        time.sleep(seconds * decisions)
        return 10 * decisions

    return run


def test_cases_take_turns_after_the_warm_up():
    log = []
    cases, runners = [case(), case()], [napping(log, "A"), napping(log, "B")]
    take_turns(cases, runners, Budget(repetitions=3, seconds=0.004))
    assert "".join(log[-6:]) == "ABABAB"


def test_a_turn_lasts_as_long_as_asked():
    decisions = decisions_per_turn(case(), napping(seconds=0.002), 0.1)
    # Naps are never shorter than asked, and on a busy machine longer.
    assert 5 <= decisions <= 50


def test_a_turn_holds_one_decision_at_least():
    assert decisions_per_turn(case(), napping(seconds=0.02), 0.001) == 1


def test_a_nap_costs_wall_time_but_no_cpu_time():
    sample = take(case(batch=4), napping(seconds=0.05), 2)
    assert sample.wall_s >= 0.1
    assert sample.cpu_s < 0.05
    assert (sample.decisions, sample.physics_steps) == (8, 20)


def test_work_costs_cpu_time():
    def busy(decisions):
        end = time.process_time() + 0.05 * decisions
        while time.process_time() < end:
            pass
        return 10 * decisions

    assert take(case(), busy, 1).cpu_s >= 0.05


def test_torch_gets_its_threads_back():
    before = torch.get_num_threads()
    with torch_threads(before + 1):
        assert torch.get_num_threads() == before + 1
    assert torch.get_num_threads() == before
