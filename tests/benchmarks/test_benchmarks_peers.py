"""HighwayEnv is run on our scenario: vehicles and lanes, ten physics steps a decision, one decision a second."""

from __future__ import annotations

import pytest

from ganlane.benchmarks.peers import (
    highway_env_case,
    highway_env_settings,
    highway_env_version,
    start_highway_env,
)
from ganlane.config.env import EnvConfig

pytest.importorskip("highway_env", reason="highway-env is not installed; it comes with the extra 'bench'")


def test_vehicles_lanes_and_time_are_ours():
    run = start_highway_env(highway_env_settings(EnvConfig()), seed=0)
    assert len(run.env.road.vehicles) == 9
    assert len(run.env.road.network.lanes_list()) == 3
    before, frames, step = run.env.time, [], run.env.road.step
    run.env.road.step = lambda dt: (frames.append(dt), step(dt))[1]
    assert run(1) == 10
    assert frames == [0.1] * 10
    assert run.env.time - before == pytest.approx(1.0)


def test_an_episode_that_ends_is_followed_by_another(monkeypatch):
    run = start_highway_env(highway_env_settings(EnvConfig(timeout_s=2.0)), seed=0)
    resets, reset = [], run.env.reset
    monkeypatch.setattr(run.env, "reset", lambda **k: (resets.append(k), reset(**k))[1])
    assert run(6) == 60
    assert len(resets) >= 3


def test_a_case_says_what_it_is():
    case = highway_env_case("sim", "speed", EnvConfig(vehicles=5, lanes=2), seed=0)
    assert case.labels.system == f"HighwayEnv {highway_env_version()}"
    assert (case.labels.vehicles, case.labels.lanes, case.labels.batch) == (5, 2, 1)
    assert case.start()(2) == 20
