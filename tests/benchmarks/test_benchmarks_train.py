"""The suite of training: what takes turns, that it learns as it says, and what follows from rows."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from ganlane import keys
from ganlane.benchmarks import Budget, measure
from ganlane.benchmarks import train as train_module
from ganlane.benchmarks.systems import Scenario
from ganlane.benchmarks.timing import take
from ganlane.benchmarks.train import TrainOptions, TrainSuite
from ganlane.benchmarks.train_findings import AIM, MISSED, MUST, SYSTEM, best_rows, speeds
from ganlane.benchmarks.train_loop import Training, advance, filled_run, with_gradients
from ganlane.config.bench import BenchConfig
from ganlane.config.env import EnvConfig
from ganlane.config.traffic import IdmMobilTrafficConfig, IdmTrafficConfig
from ganlane.errors import UserError
from ganlane.parameters.agent import RainbowConfig
from ganlane.parameters.observation import ObservationConfig
from ganlane.parameters.reward import RewardParameters

SCENARIO = Scenario(EnvConfig(), IdmMobilTrafficConfig(), ObservationConfig(), RewardParameters())
TRAFFICS = {"idm_mobil": IdmMobilTrafficConfig(), "idm": IdmTrafficConfig()}
RAINBOW = RainbowConfig(hidden=(16, 16), batch_size=32, decisions_per_update=8, capacity=512, warmup=64)
TRAINING = Training(SCENARIO, RAINBOW, stored=300)


def suite(**options):
    small = {"batches": (16,), "stored": 64, "budget": Budget(2, 0.001), "peers": False}
    return TrainSuite(TrainOptions(SCENARIO, TRAFFICS, RAINBOW, **{**small, **options}))


@pytest.fixture(scope="module")
def run():
    return filled_run(TRAINING, "eager", "cpu", 16)[0]


def test_the_buffer_is_filled_with_driven_transitions_and_different_priorities(run):
    replay = run.agent.replay
    assert len(replay) == 300
    rows = replay[:]
    torch.testing.assert_close(rows["observation"][64:128], rows["observation"][:64])
    assert not torch.equal(rows["observation"][0], rows["observation"][1])
    priorities = replay.sampler.priorities.view(-1)
    assert len(priorities[:300].unique()) > 250
    assert (priorities[300:] == 0).all()


def test_every_decision_is_stored_and_paid_for_by_updates(run):
    decisions, updates = run.decisions, run.agent.updates
    before = [p.clone() for p in run.agent.network.parameters()]
    simulated = advance(run, 3)
    assert run.decisions - decisions == 3 * 16
    assert run.agent.updates - updates == 3 * 16 // 8
    assert 0 < simulated <= 3 * 16 * 10
    assert len(run.agent.replay) == 300 + 3 * 16
    assert any(not torch.equal(a, b) for a, b in zip(before, run.agent.network.parameters()))


def test_it_learns_though_cases_are_timed_without_gradients(run):
    updates = run.agent.updates
    case = suite(modes=("eager",), threads=(1,)).groups()[0].cases[0]
    sample = take(case, with_gradients(lambda decisions: advance(run, decisions)), 2)
    assert run.agent.updates - updates == 2 * 16 // 8
    assert sample.physics_steps > 0
    assert not run.agent.replay[:][keys.OBSERVATION].is_inference()


def test_every_traffic_takes_turns_in_every_mode_batch_and_thread_count():
    groups = suite(batches=(2, 4)).groups()
    assert [(group.threads, group.cases[0].labels.batch) for group in groups] == [(1, 2), (1, 4), (2, 2), (2, 4)]
    seen = [(case.labels.traffic, case.labels.mode) for case in groups[0].cases]
    assert seen == [(traffic, mode) for traffic in TRAFFICS for mode in ("eager", "compiled")]
    assert groups[0].reference is None
    gpu = suite(devices=("cpu", "cuda")).groups()
    assert [(group.cases[0].labels.device, group.threads) for group in gpu] == [("cpu", 1), ("cpu", 2), ("cuda", 1)]


def test_a_run_has_rows_verdicts_shares_and_losses():
    measured = suite(modes=("eager",), threads=(1,))
    numbers = measure(measured, Budget(repetitions=2, seconds=0.001))
    assert [(row["system"], row["traffic"]) for row in numbers["rows"]] == [(SYSTEM, name) for name in TRAFFICS]
    assert all(row["decisions_per_s"] > 0 for row in numbers["rows"])
    assert [speed["times_peer"] for speed in numbers["speeds"]] == [None, None]
    for shares in numbers["shares"]:
        assert sum(shares["shares"].values()) == pytest.approx(1.0)
        assert sum(shares["totals"].values()) == pytest.approx(1.0)
    assert [loss["milliseconds"] > 0 for loss in numbers["losses"]] == [True] * 3
    assert all(loss["cpu_milliseconds"] >= 0 for loss in numbers["losses"])
    titles = [table.title for table in measured.tables(numbers["rows"], numbers)]
    assert len(titles) == 4


def test_what_cannot_be_measured_is_said(monkeypatch):
    monkeypatch.setattr(train_module, "baselines_version", lambda: None)
    alone = suite(peers=True)
    assert "stable-baselines3" in alone.notes[0]
    assert alone.groups()[0].reference is None
    plain = TrainSuite(replace(suite().options, agent=replace(RAINBOW, distributional=False)))
    assert "not distributional" in plain.notes[0]
    assert plain._losses() == []


def row(traffic, rate, system=SYSTEM, **labels):
    usual = {"device": "cpu", "mode": "eager", "threads": 1, "batch": 256}
    return {"system": system, "traffic": traffic, "decisions_per_s": rate, **usual, **labels}


ROWS = [
    row("idm_mobil", 4000.0),
    row("idm_mobil", 6000.0, mode="compiled"),
    row("idm_mobil", 90_000.0, device="cuda"),
    row("gan", 1500.0),
    row("idm", 9000.0),
    row("its own", 60.0, system="peer"),
    row("its own", 50.0, system="peer", threads=2),
]


def test_each_traffic_counts_at_its_best_on_each_device():
    assert [best["decisions_per_s"] for best in best_rows(ROWS)] == [6000.0, 90_000.0, 1500.0, 9000.0]


def test_verdicts_are_those_of_the_targets():
    found = speeds(ROWS, 256, 64)
    assert [speed["verdict"] for speed in found] == [MUST, None, AIM, None]
    assert [speed["times_peer"] for speed in found] == [100.0, 1500.0, 25.0, 150.0]
    # 10 M decisions at 6000 a second.
    assert found[0]["schedule_minutes"] == pytest.approx(27.78, abs=0.01)
    assert found[0]["updates_per_s"] == 6000 / 64
    assert speeds([row("gan", 799.0)], 256, 64)[0]["verdict"] == MISSED


def test_other_learning_than_was_asked_for_gets_no_verdict():
    assert {speed["verdict"] for speed in speeds(ROWS, 32, 64)} == {None}
    assert {speed["verdict"] for speed in speeds(ROWS, 256, 128)} == {None}


@pytest.mark.parametrize(
    ("options", "part"),
    [
        ({"train_traffics": ["nobody"]}, "train_traffics=nobody"),
        ({"train_batches": []}, "train_batches"),
        ({"train_stored": 100}, "agent.batch_size=256"),
        ({"train_stored": 2_000_000}, "agent.capacity=1000000"),
    ],
)
def test_what_cannot_be_trained_is_refused(options, part):
    with pytest.raises(UserError, match=part):
        BenchConfig(**options)


def test_quick_is_small_and_eager():
    quick = BenchConfig(suite="train", quick=True).shortened()
    assert (quick.train_batches, quick.train_stored, quick.modes) == ([64], 1000, ["eager"])
    assert BenchConfig(quick=True).shortened().modes == ["eager", "compiled"]
