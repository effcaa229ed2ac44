"""The suite of training: what takes turns, that it learns as it says, and its peer on the same schedule."""

from __future__ import annotations

import pytest
import torch

from ganlane import keys
from ganlane.bench import train as train_module
from ganlane.bench.measure import measure, take_turn
from ganlane.bench.systems import Scenario, highway_env_settings
from ganlane.bench.train import (
    SYSTEM,
    Training,
    TrainSuite,
    advance,
    baselines_case,
    filled_run,
    speeds,
    start_baselines,
    with_gradients,
)
from ganlane.config.commands import BenchConfig
from ganlane.config.env import EnvConfig
from ganlane.config.traffic import IdmMobilTrafficConfig
from ganlane.parameters.agent import RainbowConfig
from ganlane.parameters.observation import ObservationConfig, RewardParameters

SCENARIO = Scenario(EnvConfig(), IdmMobilTrafficConfig(), ObservationConfig(), RewardParameters())
RAINBOW = RainbowConfig(hidden=(16, 16), batch_size=32, decisions_per_update=8, capacity=512, warmup=64)
TRAINING = Training(SCENARIO, RAINBOW, stored=300)


def suite(**options):
    small = {"train_batches": [16], "train_stored": 64, "peers": False, "devices": ["cpu"]}
    traffics = {"train_traffics": ["idm_mobil", "idm"], "agent": RAINBOW}
    return TrainSuite(BenchConfig(suite="train", **{**small, **traffics, **options}))


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


def test_every_decision_is_stored_and_followed_by_its_updates(run):
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
    case = suite(modes=["eager"], threads=[1]).groups()[0].cases[0]
    sample = take_turn(case, with_gradients(lambda decisions: advance(run, decisions)), 2)
    assert run.agent.updates - updates == 2 * 16 // 8
    assert sample.physics_steps > 0
    assert not run.agent.replay[:][keys.OBSERVATION].is_inference()


def test_every_traffic_takes_turns_in_every_mode_batch_and_thread_count():
    groups = suite(train_batches=[2, 4]).groups()
    assert [(group.threads, group.cases[0].labels.batch) for group in groups] == [(1, 2), (1, 4), (2, 2), (2, 4)]
    seen = [(case.labels.traffic, case.labels.mode) for case in groups[0].cases]
    assert seen == [(traffic, mode) for traffic in ("idm_mobil", "idm") for mode in ("eager", "compiled", "native")]
    assert groups[0].reference is None


def test_a_run_has_rows_and_the_best_of_each_traffic():
    measured = suite(modes=["eager"], threads=[1])
    numbers = measure(measured, repetitions=2, seconds=0.001)
    assert [(row["system"], row["traffic"]) for row in numbers["rows"]] == [(SYSTEM, "idm_mobil"), (SYSTEM, "idm")]
    assert [speed["times_peer"] for speed in numbers["speeds"]] == [None, None]
    assert [len(table.lines) for table in measured.tables(numbers["rows"], numbers)] == [2, 2]


def test_each_traffic_is_compared_at_its_best_with_the_peer_at_its_best():
    rows = [
        {"system": system, "traffic": traffic, "device": "cpu", "decisions_per_s": rate}
        for system, traffic, rate in [
            (SYSTEM, "idm_mobil", 4000.0),
            (SYSTEM, "idm_mobil", 6000.0),
            (SYSTEM, "gan", 1500.0),
            ("peer", "its own", 60.0),
            ("peer", "its own", 50.0),
        ]
    ]
    assert [row["times_peer"] for row in speeds(rows)] == [100.0, 25.0]


def test_without_the_peer_a_sentence_says_what_to_install(monkeypatch):
    monkeypatch.setattr(train_module, "installed_version", lambda package: None)
    alone = suite(peers=True)
    assert "stable-baselines3" in alone.notes[0]
    assert alone.groups()[0].reference is None


def test_quick_is_small_and_eager():
    quick = BenchConfig(suite="train", quick=True).shortened()
    assert (quick.train_batches, quick.train_stored, quick.modes) == ([64], 1000, ["eager"])
    assert BenchConfig(quick=True).shortened().modes == ["eager", "compiled", "native"]


# stable-baselines3

ROAD = EnvConfig(vehicles=4, lanes=2)
LEARNER = RainbowConfig(hidden=(12, 8), batch_size=16, decisions_per_update=8, capacity=64, warmup=16)


@pytest.fixture(scope="module")
def baseline():
    """A runner, and stable-baselines3's model in it."""
    pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed; extra 'bench'")
    pytest.importorskip("highway_env", reason="highway-env is not installed; extra 'bench'")
    run = start_baselines(highway_env_settings(ROAD), LEARNER, seed=0)
    return run, run.__closure__[0].cell_contents.model


def test_the_baseline_has_our_network_road_and_batch(baseline):
    _, model = baseline
    linear = [layer for layer in model.q_net.q_net if isinstance(layer, torch.nn.Linear)]
    assert [layer.out_features for layer in linear[:-1]] == [12, 8]
    road = model.env.envs[0].unwrapped.road
    assert (len(road.vehicles), len(road.network.lanes_list())) == (4, 2)
    assert (model.exploration_rate, model.replay_buffer.pos) == (0.05, 16)


def test_the_baseline_updates_once_per_so_many_decisions_whatever_the_turns(baseline, monkeypatch):
    run, model = baseline
    taken, step = [], model.env.step
    monkeypatch.setattr(model.env, "step", lambda actions: (taken.append(1), step(actions))[1])
    monkeypatch.setattr(model, "train", lambda **options: taken.append(options))
    assert run(5) == 50
    assert run(20) == 200
    update = {"gradient_steps": 1, "batch_size": 16}
    assert taken == [*[1] * 8, update, *[1] * 8, update, *[1] * 8, update, 1]


def test_the_baseline_learns_though_cases_are_timed_without_gradients(baseline):
    run, model = baseline
    before = [p.clone() for p in model.q_net.parameters()]
    case = baselines_case(suite(env=ROAD, agent=LEARNER, train_stored=16), 1)
    sample = take_turn(case, run, 8)
    assert (sample.decisions, sample.physics_steps) == (8, 80)
    assert any(not torch.equal(a, b) for a, b in zip(before, model.q_net.parameters()))
