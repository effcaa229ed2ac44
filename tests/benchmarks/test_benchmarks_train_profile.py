"""Timers count a part for itself and leave the loop unchanged; both losses see usual transitions."""

from __future__ import annotations

import time

import pytest
import torch

from benchmarks import train_profile
from benchmarks.train_profile import (
    PARTS,
    REST,
    Clock,
    compare_losses,
    instrumented,
    share_table,
    take_shares,
    timed_calls,
)
from ganlane.bench.suites import TrainSuite
from ganlane.bench.systems import Scenario, Training, filled_run
from ganlane.settings.commands import BenchConfig
from ganlane.settings.agent import RainbowConfig

CONFIG = BenchConfig(suite="train", threads=[1, 2])
AGENT = RainbowConfig(
    hidden=(16, 16), batch_size=32, decisions_per_update=8, capacity=256, warmup=64
)
TRAINING = Training(Scenario.of(CONFIG, CONFIG.chosen_train_traffics()["idm_mobil"]), AGENT, 128)


class Hands:
    """A clock that can be set."""

    def __init__(self):
        self.now = 0.0

    def perf_counter(self):
        return self.now


class Worker:
    """Works for so long; one call is inside the other."""

    def __init__(self, hands):
        self.hands = hands

    def outer(self):
        self.hands.now += 1.0
        self.inner()
        self.hands.now += 2.0
        return "done"

    def inner(self):
        self.hands.now += 4.0

    def broken(self):
        self.hands.now += 3.0
        raise ValueError("broken")


@pytest.fixture
def hands(monkeypatch):
    hands = Hands()
    monkeypatch.setattr(train_profile, "time", hands)
    return hands


def test_what_runs_inside_is_counted_for_itself_alone(hands):
    worker, clock = Worker(hands), Clock()
    with instrumented([(worker, "outer", "a"), (worker, "inner", "b")], clock):
        assert worker.outer() == "done"
        hands.now += 1.0
    assert clock.shares() == {"a": 3 / 8, "b": 4 / 8, REST: 1 / 8}


def test_a_call_that_fails_is_counted_and_left_and_afterwards_everything_is_as_it_was(hands):
    worker, clock = Worker(hands), Clock()
    with pytest.raises(ValueError, match="broken"), instrumented([(worker, "broken", "a")], clock):
        worker.broken()
    hands.now += 1.0
    assert clock.shares() == {"a": 3 / 4, REST: 1 / 4}
    worker.own = own = lambda: None
    with instrumented([(worker, "outer", "a"), (worker, "own", "b")], Clock()):
        assert "outer" in vars(worker)
        assert worker.own is not own
    assert "outer" not in vars(worker)
    assert worker.own is own


def test_every_part_of_the_real_loop_takes_time():
    run, env = filled_run(TRAINING, "eager", "cpu", 8)
    backward, updates = torch.autograd.backward, run.agent.updates
    begun = time.perf_counter()
    shares, rate = take_shares(run, env, 5)
    assert rate >= 5 * 8 / (time.perf_counter() - begun)
    assert run.agent.updates == updates + 5
    assert shares.keys() == {part for _, _, part in timed_calls(run, env)} | {REST}
    assert all(share > 0 for share in shares.values())
    assert sum(shares.values()) == pytest.approx(1.0)
    assert torch.autograd.backward is backward
    assert not {"step_and_maybe_reset", "_step"} & vars(env).keys()
    table = share_table({"idm_mobil": (shares, rate)}, "eager")
    assert len(table.lines) == len(PARTS) + sum(map(len, PARTS.values()))


def test_both_losses_and_the_whole_update_are_measured_for_every_number_of_threads():
    table = compare_losses(TrainSuite(CONFIG), TRAINING, 2, 0.001)
    names = [train_profile.THEIRS, train_profile.OURS, train_profile.WHOLE_UPDATE]
    assert [line[:3] for line in table.lines] == [
        [name, str(n), "32"] for n in (1, 2) for name in names
    ]
