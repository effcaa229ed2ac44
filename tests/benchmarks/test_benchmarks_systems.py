"""What is timed is what it says: the same physics as in the environment, and only steps that were simulated."""

from __future__ import annotations

import pytest
import torch

from ganlane import keys
from ganlane.benchmarks.systems import (
    Scenario,
    bare_steps,
    build,
    first_state,
    start_environment,
    start_physics,
)
from ganlane.config.env import EnvConfig
from ganlane.config.traffic import IdmMobilTrafficConfig, IdmTrafficConfig
from ganlane.parameters.observation import ObservationConfig
from ganlane.parameters.reward import RewardParameters


def scenario(traffic=None, **env):
    traffic = traffic or IdmMobilTrafficConfig()
    return Scenario(EnvConfig(**env), traffic, ObservationConfig(), RewardParameters(), seed=3)


def test_bare_physics_moves_everybody_as_the_environment_does():
    env = build(scenario(), "eager", "cpu", 5)
    start = env.reset()
    vehicles, step = bare_steps(env.base_env, start, 30)
    state = start
    for _ in range(3):
        state.set(keys.ACTION, torch.full((5,), keys.KEEP))
        _, state = env.step_and_maybe_reset(state)
    assert torch.equal(step, state[keys.STEP])
    for name in ("x", "y", "speed", "heading", "target_lane"):
        assert torch.equal(getattr(vehicles, name), state[keys.VEHICLES, name]), name


def test_bare_physics_goes_on_past_goal_and_time_out():
    run = start_physics(scenario(goal_m=20.0, timeout_s=2.0), "eager", "cpu", 4)
    assert run(5) == 4 * 5 * 10
    assert run(5) == 4 * 5 * 10


def test_only_simulated_steps_are_counted():
    # On a single lane every change leaves the road at once; whoever keeps to it drives ten steps. Two vehicles
    # that follow IDM do not crash.
    run = start_environment(scenario(IdmTrafficConfig(), lanes=1, vehicles=2), "eager", "cpu", 8)
    kept = sum(int((run.actions[i % 64] == keys.KEEP).sum()) for i in range(1, 13))
    assert 0 < kept < 12 * 8
    assert run(7) + run(5) == 10 * kept


def test_a_shorter_decision_has_fewer_physics_steps():
    assert start_physics(scenario(decision_period_s=0.2), "eager", "cpu", 3)(4) == 3 * 4 * 2


def test_the_state_holds_the_observation():
    assert first_state(scenario(), 2)[keys.OBSERVATION].shape[0] == 2


def test_actions_are_the_same_for_the_same_seed():
    one, other = (start_environment(scenario(), "eager", "cpu", 4) for _ in range(2))
    assert one(3) == other(3)
    assert all(torch.equal(a, b) for a, b in zip(one.actions, other.actions))


@pytest.mark.parametrize("batch", [1, 3])
def test_every_batch_runs(batch):
    assert start_environment(scenario(), "eager", "cpu", batch)(10) > 0
