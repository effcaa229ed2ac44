"""What training is held against: TorchRL's loss on the same network, stable-baselines3 on the same schedule."""

from __future__ import annotations

import pytest
import torch

from ganlane.benchmarks.peers import highway_env_settings
from ganlane.benchmarks.systems import Scenario
from ganlane.benchmarks.timing import Budget, take
from ganlane.benchmarks.train_loop import Training, make_agent
from ganlane.benchmarks.train_losses import OURS, THEIRS, WHOLE, compare_losses, random_transitions, start_update
from ganlane.benchmarks.train_peer import baselines_case, start_baselines
from ganlane.config.env import EnvConfig
from ganlane.config.traffic import IdmMobilTrafficConfig
from ganlane.parameters.agent import RainbowConfig
from ganlane.parameters.observation import ObservationConfig
from ganlane.parameters.reward import RewardParameters

SCENARIO = Scenario(EnvConfig(), IdmMobilTrafficConfig(), ObservationConfig(), RewardParameters())
RAINBOW = RainbowConfig(hidden=(16, 16), batch_size=32, decisions_per_update=8, capacity=512, warmup=64)
TRAINING = Training(SCENARIO, RAINBOW, stored=128)


def test_both_losses_and_the_whole_update_are_measured_for_every_number_of_threads():
    found = compare_losses(TRAINING, (1, 2), Budget(2, 0.001))
    assert [(row["system"], row["threads"]) for row in found] == [
        (system, threads) for threads in (1, 2) for system in (THEIRS, OURS, WHOLE)
    ]
    assert {row["batch_size"] for row in found} == {32}


def test_random_transitions_are_such_as_the_window_gives():
    agent = make_agent(TRAINING)
    rows = random_transitions(agent, 40)
    assert rows["observation"].shape == (40, agent.network.config.observation_size)
    assert rows["next", "reward"].shape == rows["next", "terminated"].shape == (40, 1)
    assert set(rows["action"].tolist()) == {0, 1, 2}


def test_a_whole_update_changes_the_network_and_simulates_nothing():
    assert start_update(TRAINING)(2) == 0


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
    sample = take(baselines_case(ROAD, LEARNER, 1, seed=0), run, 8)
    assert (sample.decisions, sample.physics_steps) == (8, 80)
    assert any(not torch.equal(a, b) for a, b in zip(before, model.q_net.parameters()))
