"""The suites of the simulator and of the traffic: what is timed, and what follows from the rows."""

from __future__ import annotations

import time
from importlib.metadata import version

import pytest
import torch

from ganlane import keys
from ganlane.bench import sim as sim_module
from ganlane.bench.measure import measure
from ganlane.bench.sim import ENVIRONMENT, GYMNASIUM, PHYSICS, SimSuite, exponent, scaling
from ganlane.bench.systems import (
    GymnasiumRunner,
    HighwayEnvRunner,
    Scenario,
    bare_steps,
    highway_env_case,
    highway_env_settings,
    start_environment,
    start_envpool,
    start_physics,
)
from ganlane.bench.traffic import SYSTEM, TrafficSuite
from ganlane.config.commands import BenchConfig
from ganlane.config.env import EnvConfig
from ganlane.config.traffic import IdmMobilTrafficConfig, IdmTrafficConfig, TrafficConfig
from ganlane.data import SyntheticTraffic, synthetic_scenes, write_scene_csv
from ganlane.errors import UserError
from ganlane.parameters.observation import ObservationConfig, RewardParameters

SHORT = {"repetitions": 2, "seconds": 0.001}


def scenario(traffic=None, **env):
    traffic = traffic or IdmMobilTrafficConfig()
    return Scenario(EnvConfig(**env), traffic, ObservationConfig(), RewardParameters(), seed=3)


def suite(kind=SimSuite, **options):
    usual = {"traffic": IdmTrafficConfig(), "memory": False, "modes": ["eager"], "threads": [1], "devices": ["cpu"]}
    return kind(BenchConfig(**{**usual, "peers": False, **options}))


# What is timed


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


def test_bare_physics_goes_on_past_goal_and_time_out():
    run = start_physics(scenario(goal_m=20.0, timeout_s=2.0), "eager", "cpu", 4)
    assert run(5) == run(5) == 4 * 5 * 10
    assert start_physics(scenario(decision_period_s=0.2), "eager", "cpu", 3)(4) == 3 * 4 * 2


def test_only_simulated_steps_are_counted():
    # On a single lane every change leaves the road at once; whoever keeps to it drives ten steps. Two vehicles
    # that follow IDM do not crash.
    run = start_environment(scenario(IdmTrafficConfig(), lanes=1, vehicles=2), "eager", "cpu", 8)
    kept = sum(int((run.actions[i % 64] == keys.KEEP).sum()) for i in range(1, 13))
    assert 0 < kept < 12 * 8
    assert run(7) + run(5) == 10 * kept


def test_actions_are_the_same_for_the_same_seed():
    one, other = (start_environment(scenario(), "eager", "cpu", 4) for _ in range(2))
    assert one(3) == other(3)
    assert all(torch.equal(a, b) for a, b in zip(one.actions, other.actions))


# suite=sim


def test_every_batch_is_run_bare_and_whole_in_every_mode_and_thread_count():
    groups = suite(batches=[1, 8], modes=["eager", "compiled"], threads=[1, 2]).groups()
    speed = [case.labels for group in groups for case in group.cases if case.labels.part == "speed"]
    seen = {(label.threads, label.batch, label.system, label.mode) for label in speed}
    assert len(seen) == len(speed) == 2 * 2 * 2 * 2


def test_a_gpu_is_run_with_one_thread_count(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    places = suite(devices=["cpu", "cuda"], threads=[1, 2]).places()
    assert places == [("cpu", 1), ("cpu", 2), ("cuda", 1)]


def test_growth_is_measured_side_by_side():
    groups = suite(batches=[1, 8, 32], linear_from=8, scaling_batch=4).groups()
    growth = {group.title: [case.labels for case in group.cases] for group in groups if "growth" in group.title}
    assert len(growth) == 4
    assert [label.batch for label in growth[f"{PHYSICS}, growth with the batch"]] == [8, 32]
    vehicles = growth[f"{ENVIRONMENT}, growth with the vehicles"]
    assert [label.vehicles for label in vehicles] == [9, 15, 30, 60]
    assert {label.batch for label in vehicles} == {4}


def test_the_road_is_kept_full_except_in_replayed_traffic_where_a_note_says_so(tmp_path):
    path = tmp_path / "scenes.csv"
    write_scene_csv(synthetic_scenes(SyntheticTraffic(scenes=2, vehicles=12, seconds=7.0)), path)
    replay = TrafficConfig("ganlane.traffic.ReplayTraffic", {"path": str(path)})
    played = suite(traffic=replay, batches=[2], vehicle_counts=[9])
    assert not played.config.env.recycle
    assert any("Not recycled" in note for note in played.notes)
    assert len(measure(played, **SHORT)["rows"]) == 2
    ruled = suite()
    assert ruled.config.env.recycle
    assert not ruled.notes


class ByHand(EnvConfig):
    """A scene set by hand."""


def test_a_scene_set_by_hand_has_no_other_number_of_vehicles():
    by_hand = suite(env=ByHand(), batches=[1, 2])
    assert not [group for group in by_hand.groups() if "vehicles" in group.title]
    assert any("growth with the vehicles" in note for note in by_hand.notes)


def test_what_cannot_be_compiled_is_left_out_with_the_reason(monkeypatch):
    def start(scenario, mode, device, batch):
        if mode == "compiled":
            raise UserError("compile=true: needs a C++ compiler; install one.")

        def run(decisions):
            time.sleep(0.001 * decisions)
            return 10 * decisions * batch

        return run

    monkeypatch.setattr(sim_module, "_START", {PHYSICS: start, ENVIRONMENT: start, GYMNASIUM: start})
    measured = suite(batches=[1, 2], vehicle_counts=[9], modes=["eager", "compiled"], linear_from=4)
    rows = measure(measured, **SHORT)["rows"]
    assert {row["mode"] for row in rows} == {"eager"}
    assert measured.notes.count("compile=true: needs a C++ compiler; install one.") == 1


def test_cost_that_doubles_with_the_size_grows_linearly():
    # Twenty decisions of the whole batch in each turn.
    rows = [
        {"part": "batch", "system": PHYSICS, "batch": batch, "wall_s": batch / 1024, "decisions": 20 * batch}
        for batch in (1024, 2048, 4096)
    ]
    (growth,) = scaling(rows)
    assert growth["milliseconds"] == pytest.approx([50, 100, 200])
    assert growth["exponent"] == pytest.approx(1)
    assert exponent([9, 15, 30], [0.3 * size**1.7 for size in (9, 15, 30)]) == pytest.approx(1.7)
    assert exponent([9, 9], [1.0, 2.0]) is None


# HighwayEnv


def test_without_the_peer_a_sentence_says_what_to_install(monkeypatch):
    monkeypatch.setattr(sim_module, "installed_version", lambda package: None)
    measured = suite(batches=[2], vehicle_counts=[2], peers=True)
    assert any("pip install" in note for note in measured.notes)
    numbers = measure(measured, **SHORT)
    assert numbers["ratios"] == []
    assert [row["ratio"] for row in numbers["rows"]] == [None, None]


@pytest.fixture
def _peer():
    pytest.importorskip("highway_env", reason="highway-env is not installed; it comes with the extra 'bench'")


@pytest.mark.usefixtures("_peer")
def test_vehicles_lanes_and_time_of_the_peer_are_ours():
    run = HighwayEnvRunner(highway_env_settings(EnvConfig()), seed=0)
    assert (len(run.env.road.vehicles), len(run.env.road.network.lanes_list())) == (9, 3)
    before, steps, step = run.env.time, [], run.env.road.step
    run.env.road.step = lambda dt: (steps.append(dt), step(dt))[1]
    assert run(1) == 10
    assert steps == [0.1] * 10
    assert run.env.time - before == pytest.approx(1.0)


@pytest.mark.usefixtures("_peer")
def test_an_episode_of_the_peer_that_ends_is_followed_by_another(monkeypatch):
    run = HighwayEnvRunner(highway_env_settings(EnvConfig(timeout_s=2.0)), seed=0)
    resets, reset = [], run.env.reset
    monkeypatch.setattr(run.env, "reset", lambda **k: (resets.append(k), reset(**k))[1])
    assert run(6) == 60
    assert len(resets) >= 3


@pytest.mark.usefixtures("_peer")
def test_the_peer_takes_turns_in_every_group_and_makes_one_row(monkeypatch):
    monkeypatch.setattr(sim_module, "installed_version", lambda name: None if name == "envpool" else version(name))
    measured = suite(batches=[1, 2], vehicle_counts=[9], linear_from=4, peers=True)
    labels = highway_env_case(measured).labels
    assert (labels.vehicles, labels.lanes, labels.batch) == (9, 3, 1)
    numbers = measure(measured, **SHORT)
    peer, *ours = numbers["rows"]
    assert peer["system"] == labels.system
    assert (peer["repetitions"], peer["ratio"]) == (2 * SHORT["repetitions"], 1.0)
    assert [row["system"] for row in ours] == [PHYSICS, ENVIRONMENT] * 2
    assert all(row["ratio"] > 0 for row in ours)
    assert [row["system"] for row in numbers["ratios"]] == [PHYSICS, ENVIRONMENT]


@pytest.mark.parametrize("batch", [1, 6])
def test_gymnasium_simulates_the_steps_that_its_episodes_last(batch):
    run = GymnasiumRunner(scenario(IdmTrafficConfig(), lanes=1, vehicles=2, goal_m=200.0), "native", "cpu", batch)
    kept = sum(int((run.actions[i % 64] == keys.KEEP).sum()) for i in range(1, 26))
    driven = run(25)
    assert (
        8 * kept < driven <= 10 * kept
    )  # the last decision before the goal is shorter; whoever changes lanes is out


def test_envpool_drives_the_same_road():
    pytest.importorskip("envpool")
    assert start_envpool(EnvConfig(), 4, 1, seed=0)(3) == 4 * 3 * 10


# suite=traffic


def test_every_traffic_takes_turns_in_every_mode_batch_and_thread_count():
    options = {"traffics": ["idm", "gan"], "modes": ["eager", "compiled"], "threads": [1, 2]}
    groups = suite(TrafficSuite, traffic_batches=[2, 4], **options).groups()
    assert [(group.threads, group.cases[0].labels.batch) for group in groups] == [(1, 2), (1, 4), (2, 2), (2, 4)]
    seen = [(case.labels.system, case.labels.traffic, case.labels.mode) for case in groups[0].cases]
    assert seen == [(SYSTEM, traffic, mode) for traffic in ("idm", "gan") for mode in ("eager", "compiled")]


def test_steps_of_a_traffic_are_counted_as_they_are_driven():
    measured = suite(TrafficSuite, traffics=["idm", "gan"], traffic_batches=[3])
    assert measured.groups()[0].cases[0].start()(2) == 2 * 10 * 3
    numbers = measure(measured, **SHORT)
    assert [row["traffic"] for row in numbers["speeds"]] == ["idm", "gan"]
    (table,) = measured.tables(numbers["rows"], numbers)
    assert len(table.lines) == 2
