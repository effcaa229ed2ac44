"""The systems that are timed drive, count and learn as they say, and the peers do on the same road
and schedule.
"""

from __future__ import annotations

from functools import partial

import pytest
import torch

from ganlane import keys
from ganlane.bench.measure import take_turn
from ganlane.bench.suites import TrainSuite
from ganlane.bench.systems import (
    BaselinesRunner,
    GymnasiumRunner,
    HighwayEnvRunner,
    Scenario,
    Training,
    advance,
    bare_steps,
    filled_run,
    start_environment,
    start_envpool,
    start_physics,
)
from ganlane.settings.commands import BenchConfig
from ganlane.settings.env import EnvConfig
from ganlane.settings.traffic import IdmMobilTrafficConfig, IdmTrafficConfig
from ganlane.settings.agent import RainbowConfig
from ganlane.settings.observation import ObservationConfig, RewardParameters


def scenario(traffic=None, **env):
    traffic = traffic or IdmMobilTrafficConfig()
    return Scenario(EnvConfig(**env), traffic, ObservationConfig(), RewardParameters(), seed=3)


def test_bare_physics_moves_everybody_as_the_environment_does():
    env = scenario().build("eager", "cpu", 5)
    state = env.reset()
    vehicles, step = bare_steps(env.base_env, state, 30)
    for _ in range(3):
        state.set(keys.ACTION, torch.full((5,), keys.KEEP))
        _, state = env.step_and_maybe_reset(state)
    assert torch.equal(step, state[keys.STEP])
    for name in ("x", "y", "speed", "heading", "target_lane"):
        assert torch.equal(getattr(vehicles, name), state[keys.VEHICLES, name]), name


@pytest.mark.parametrize("mode", ["eager", "native"])
def test_bare_physics_goes_on_past_goal_and_time_out(mode):
    run = start_physics(scenario(goal_m=20.0, timeout_s=2.0), mode, "cpu", 4)
    assert run(5) == run(5) == 4 * 5 * 10
    assert start_physics(scenario(decision_period_s=0.2), mode, "cpu", 3)(4) == 3 * 4 * 2


def test_only_simulated_steps_are_counted():
    # On a single lane every change leaves the road at once; whoever keeps to it drives ten steps.
    # Two vehicles that follow IDM do not crash.
    run = start_environment(scenario(IdmTrafficConfig(), lanes=1, vehicles=2), "eager", "cpu", 8)
    kept = sum(int((run.actions[i % 64] == keys.KEEP).sum()) for i in range(1, 13))
    assert 0 < kept < 12 * 8
    assert run(7) + run(5) == 10 * kept


def test_actions_are_the_same_for_the_same_seed():
    one, other = (start_environment(scenario(), "eager", "cpu", 4) for _ in range(2))
    assert one(3) == other(3)
    assert all(torch.equal(a, b) for a, b in zip(one.actions, other.actions))


@pytest.mark.parametrize("batch", [1, 6])
def test_gymnasium_simulates_the_steps_that_its_episodes_last(batch):
    run = GymnasiumRunner(
        scenario(IdmTrafficConfig(), lanes=1, vehicles=2, goal_m=200.0), "native", "cpu", batch
    )
    kept = sum(int((run.actions[i % 64] == keys.KEEP).sum()) for i in range(1, 26))
    # The last decision before the goal is shorter; whoever changes lanes is out.
    assert 8 * kept < run(25) <= 10 * kept


# Training

RAINBOW = RainbowConfig(
    hidden=(16, 16), batch_size=32, decisions_per_update=8, capacity=512, warmup=64
)


def train_suite(**options):
    small = {
        "train_batches": [16],
        "train_stored": 64,
        "modes": ["eager"],
        "threads": [1],
        "devices": ["cpu"],
    }
    return TrainSuite(
        BenchConfig(suite="train", **{**small, "peers": False, "agent": RAINBOW, **options})
    )


@pytest.fixture(scope="module")
def run():
    return filled_run(Training(scenario(), RAINBOW, stored=300), "eager", "cpu", 16)[0]


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
    sample = take_turn(train_suite().groups()[0].cases[0], partial(advance, run), 2)
    assert run.agent.updates - updates == 2 * 16 // 8
    assert sample.physics_steps > 0
    assert not run.agent.replay[:][keys.OBSERVATION].is_inference()


# HighwayEnv, EnvPool, stable-baselines3


@pytest.fixture
def _peer():
    pytest.importorskip(
        "highway_env", reason="highway-env is not installed; it comes with the extra 'bench'"
    )


@pytest.mark.usefixtures("_peer")
def test_vehicles_lanes_and_time_of_the_peer_are_ours():
    run = HighwayEnvRunner(EnvConfig(), seed=0)
    assert (len(run.env.road.vehicles), len(run.env.road.network.lanes_list())) == (9, 3)
    before, steps, step = run.env.time, [], run.env.road.step
    run.env.road.step = lambda dt: (steps.append(dt), step(dt))[1]
    assert run(1) == 10
    assert steps == [0.1] * 10
    assert run.env.time - before == pytest.approx(1.0)


@pytest.mark.usefixtures("_peer")
def test_an_episode_of_the_peer_that_ends_is_followed_by_another(monkeypatch):
    run = HighwayEnvRunner(EnvConfig(timeout_s=2.0), seed=0)
    resets, reset = [], run.env.reset
    monkeypatch.setattr(run.env, "reset", lambda **k: (resets.append(k), reset(**k))[1])
    assert run(6) == 60
    assert len(resets) >= 3


def test_envpool_drives_the_same_road():
    pytest.importorskip("envpool")
    assert start_envpool(EnvConfig(), 4, 1, seed=0)(3) == 4 * 3 * 10


ROAD = EnvConfig(vehicles=4, lanes=2)
LEARNER = RainbowConfig(
    hidden=(12, 8), batch_size=16, decisions_per_update=8, capacity=64, warmup=16
)


@pytest.fixture(scope="module")
def baseline():
    pytest.importorskip(
        "stable_baselines3", reason="stable-baselines3 is not installed; extra 'bench'"
    )
    pytest.importorskip("highway_env", reason="highway-env is not installed; extra 'bench'")
    return BaselinesRunner(ROAD, LEARNER, seed=0)


def test_the_baseline_has_our_network_road_and_batch(baseline):
    model = baseline.model
    linear = [layer for layer in model.q_net.q_net if isinstance(layer, torch.nn.Linear)]
    assert [layer.out_features for layer in linear[:-1]] == [12, 8]
    road = model.env.envs[0].unwrapped.road
    assert (len(road.vehicles), len(road.network.lanes_list())) == (4, 2)
    assert (model.exploration_rate, model.replay_buffer.pos) == (0.05, 16)


def test_the_baseline_updates_once_per_so_many_decisions_whatever_the_turns(baseline, monkeypatch):
    model = baseline.model
    taken, step = [], model.env.step
    monkeypatch.setattr(model.env, "step", lambda actions: (taken.append(1), step(actions))[1])
    monkeypatch.setattr(model, "train", lambda **options: taken.append(options))
    assert baseline(5) == 50
    assert baseline(20) == 200
    update = {"gradient_steps": 1, "batch_size": 16}
    assert taken == [*[1] * 8, update, *[1] * 8, update, *[1] * 8, update, 1]


def test_the_baseline_learns_though_cases_are_timed_without_gradients(baseline):
    before = [p.clone() for p in baseline.model.q_net.parameters()]
    peer = train_suite(env=ROAD, agent=LEARNER, train_stored=16).peer(1)
    sample = take_turn(peer, baseline, 8)
    assert (sample.decisions, sample.physics_steps) == (8, 80)
    assert any(not torch.equal(a, b) for a, b in zip(before, baseline.model.q_net.parameters()))
