"""Timers charge a part what it takes itself, and leave the loop as they found it."""

from __future__ import annotations

import time

import pytest
import torch

from ganlane.benchmarks.systems import Scenario
from ganlane.benchmarks.train_loop import Training, filled_run
from ganlane.benchmarks.train_shares import (
    PARTS,
    REST,
    SHELL,
    Clock,
    calls_of,
    instrumented,
    take_shares,
    totals,
)
from ganlane.config.env import EnvConfig
from ganlane.config.traffic import IdmMobilTrafficConfig
from ganlane.parameters.agent import RainbowConfig
from ganlane.parameters.observation import ObservationConfig
from ganlane.parameters.reward import RewardParameters


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
    monkeypatch.setattr("ganlane.benchmarks.train_shares.time", hands)
    return hands


def test_what_runs_inside_is_charged_to_itself_alone(hands):
    worker, clock = Worker(hands), Clock()
    with instrumented([(worker, "outer", "a"), (worker, "inner", "b")], clock):
        assert worker.outer() == "done"
        hands.now += 1.0
    assert clock.shares() == {"a": 3 / 8, "b": 4 / 8, REST: 1 / 8}


def test_a_call_that_fails_is_charged_and_left(hands):
    worker, clock = Worker(hands), Clock()
    with pytest.raises(ValueError, match="broken"), instrumented([(worker, "broken", "a")], clock):
        worker.broken()
    hands.now += 1.0
    assert clock.shares() == {"a": 3 / 4, REST: 1 / 4}


def test_afterwards_everything_is_as_it_was(hands):
    worker = Worker(hands)
    worker.own = own = lambda: None
    with instrumented([(worker, "outer", "a"), (worker, "own", "b")], Clock()):
        assert "outer" in vars(worker)
        assert worker.own is not own
    assert "outer" not in vars(worker)
    assert worker.own is own


def test_every_part_of_the_real_loop_takes_time():
    scenario = Scenario(EnvConfig(), IdmMobilTrafficConfig(), ObservationConfig(), RewardParameters())
    agent = RainbowConfig(hidden=(16, 16), batch_size=32, decisions_per_update=8, capacity=256, warmup=64)
    run, env = filled_run(Training(scenario, agent, 64), "eager", "cpu", 8)
    backward, updates = torch.autograd.backward, run.agent.updates
    began = time.perf_counter()
    shares, rate = take_shares(run, env, 5)
    took_s = time.perf_counter() - began
    assert run.agent.updates == updates + 5
    assert shares.keys() == {part for _, _, part in calls_of(run, env)} | {REST}
    assert all(share > 0 for share in shares.values())
    assert sum(shares.values()) == pytest.approx(1.0)
    assert rate >= 5 * 8 / took_s
    assert torch.autograd.backward is backward
    assert not {"step_and_maybe_reset", "_step"} & vars(env).keys()
    # Most of a decision is the traffic and the ego, not TorchRL's bookkeeping.
    assert shares["simulator"] + shares["traffic"] > shares[SHELL]


def test_whole_parts_add_up():
    found = totals({"simulator": 0.25, "window": 0.125, "store": 0.125, "loss": 0.25, "rest": 0.25})
    assert found.keys() == PARTS.keys()
    assert (found["simulator"], found["replay"], found["learning"], found["rest"]) == (0.25, 0.25, 0.25, 0.25)
    assert found["policy"] == 0.0
