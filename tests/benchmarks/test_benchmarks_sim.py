"""The suite of the simulator: which cases there are, and what follows from rows."""

from __future__ import annotations

import time
from dataclasses import replace

import pytest

from ganlane.benchmarks import Budget, SimOptions, SimSuite, measure
from ganlane.benchmarks import sim as sim_module
from ganlane.benchmarks.sim_findings import ENVIRONMENT, PHYSICS, ratios, scaling
from ganlane.benchmarks.systems import Scenario
from ganlane.config.env import EnvConfig
from ganlane.config.traffic import IdmTrafficConfig, TrafficConfig
from ganlane.data import SyntheticTraffic, synthetic_scenes, write_scene_csv
from ganlane.errors import UserError
from ganlane.parameters.observation import ObservationConfig
from ganlane.parameters.reward import RewardParameters

SCENARIO = Scenario(EnvConfig(), IdmTrafficConfig(), ObservationConfig(), RewardParameters())
SHORT = Budget(repetitions=2, seconds=0.001)


def suite(**options):
    return SimSuite(SimOptions(SCENARIO, **{"memory": False, "modes": ("eager",), "threads": (1,), **options}))


@pytest.fixture
def _no_peer(monkeypatch):
    monkeypatch.setattr(sim_module, "highway_env_version", lambda: None)


@pytest.mark.usefixtures("_no_peer")
def test_every_batch_is_run_bare_and_whole_in_every_mode_and_thread_count():
    groups = suite(batches=(1, 8), modes=("eager", "compiled"), threads=(1, 2)).groups()
    speed = [case.labels for group in groups for case in group.cases if case.labels.part == "speed"]
    seen = {(label.threads, label.batch, label.system, label.mode) for label in speed}
    assert len(seen) == len(speed) == 2 * 2 * 2 * 2


@pytest.mark.usefixtures("_no_peer")
def test_without_the_peer_a_sentence_says_what_to_install():
    measured = suite(batches=(2,), vehicle_counts=(2,))
    assert any("pip install" in note for note in measured.notes)
    numbers = measure(measured, SHORT)
    assert numbers["ratios"] == []
    assert [row["ratio"] for row in numbers["rows"]] == [None, None]
    assert [table.title.split(",")[0] for table in measured.tables(numbers["rows"], numbers)] == [
        "Speed",
        "Memory per environment of 9 vehicles",
    ]


def test_with_peers_off_nothing_is_said():
    assert not any("HighwayEnv" in note for note in suite(peers=False).notes)


def test_a_gpu_is_run_with_one_thread_count():
    groups = suite(peers=False, batches=(4,), devices=("cpu", "cuda"), threads=(1, 2)).groups()
    places = [(c.labels.device, c.labels.threads) for g in groups for c in g.cases if c.labels.part == "speed"]
    assert list(dict.fromkeys(places)) == [("cpu", 1), ("cpu", 2), ("cuda", 1)]


def test_growth_is_measured_side_by_side():
    groups = suite(peers=False, batches=(1, 8, 32), linear_from=8, scaling_batch=4).groups()
    growth = {group.title: [case.labels for case in group.cases] for group in groups if "growth" in group.title}
    assert len(growth) == 4
    assert [label.batch for label in growth[f"{PHYSICS}, growth with the batch"]] == [8, 32]
    vehicles = growth[f"{ENVIRONMENT}, growth with the vehicles"]
    assert [label.vehicles for label in vehicles] == [9, 15, 30, 60]
    assert {label.batch for label in vehicles} == {4}


def test_the_road_is_kept_full_except_in_replayed_traffic_where_a_note_says_so(tmp_path):
    path = tmp_path / "scenes.csv"
    write_scene_csv(synthetic_scenes(SyntheticTraffic(scenes=2, vehicles=12, seconds=7.0)), path)
    replay = replace(SCENARIO, traffic=TrafficConfig("ganlane.traffic.ReplayTraffic", {"path": str(path)}))
    played = SimSuite(
        SimOptions(replay, batches=(2,), vehicle_counts=(), modes=("eager",), peers=False, memory=False)
    )
    assert not played.options.scenario.env.recycle
    assert any("Not recycled" in note for note in played.notes)
    assert len(measure(played, SHORT)["rows"]) == 4
    ruled = suite(peers=False)
    assert ruled.options.scenario.env.recycle
    assert not ruled.notes


class ByHand(EnvConfig):
    """A scene set by hand."""


def test_a_scene_set_by_hand_has_no_other_number_of_vehicles():
    scenario = Scenario(ByHand(), SCENARIO.traffic, SCENARIO.observation, SCENARIO.reward)
    by_hand = SimSuite(SimOptions(scenario, batches=(1, 2), peers=False, memory=False))
    assert not [group for group in by_hand.groups() if "vehicles" in group.title]
    assert any("growth with the vehicles" in note for note in by_hand.notes)


@pytest.mark.usefixtures("_no_peer")
def test_what_cannot_be_compiled_is_left_out_with_the_reason(monkeypatch):
    def start(scenario, mode, device, batch):
        if mode == "compiled":
            raise UserError("compile=true: needs a C++ compiler; install one.")

        def run(decisions):
            time.sleep(0.001 * decisions)
            return 10 * decisions * batch

        return run

    monkeypatch.setattr(sim_module, "_START", {PHYSICS: start})
    measured = suite(batches=(1, 2), vehicle_counts=(9,), modes=("eager", "compiled"), linear_from=4)
    rows = measure(measured, SHORT)["rows"]
    assert {row["mode"] for row in rows} == {"eager"}
    assert measured.notes.count("compile=true: needs a C++ compiler; install one.") == 1


def test_the_peer_stands_in_every_group_and_makes_one_row(monkeypatch):
    pytest.importorskip("highway_env", reason="highway-env is not installed; it comes with the extra 'bench'")
    numbers = measure(suite(batches=(1, 2), vehicle_counts=(9,), linear_from=4), SHORT)
    peer, *ours = numbers["rows"]
    assert peer["system"].startswith("HighwayEnv")
    assert (peer["repetitions"], peer["ratio"]) == (2 * SHORT.repetitions, 1.0)
    assert [row["system"] for row in ours] == [PHYSICS, ENVIRONMENT] * 2
    assert all(row["ratio"] > 0 for row in ours)
    assert [found["required"] for found in numbers["ratios"]] == [1000, 500, 1]


def row(system, ratio, **labels):
    shared = {"part": "speed", "device": "cpu", "mode": "eager", "threads": 1, "batch": 1}
    figures = {"physics_steps_per_s": 100 * ratio, "ratio": ratio, "ratio_cpu": ratio / 2}
    return {"system": system, **shared, **figures, **labels}


def test_the_best_row_counts_and_batch_one_is_eager():
    rows = [
        row("HighwayEnv 1", 1.0),
        row(PHYSICS, 900, batch=64),
        row(PHYSICS, 1500, batch=1024, mode="compiled"),
        row(PHYSICS, 9999, batch=1024, part="batch"),
        row(ENVIRONMENT, 1.2),
        row(ENVIRONMENT, 5.0, mode="compiled"),
        row(ENVIRONMENT, 700, batch=64, threads=2),
    ]
    found = {ratio["what"]: (ratio["ratio"], ratio["mode"], ratio["batch"]) for ratio in ratios(rows)}
    assert found == {
        "bare physics, best batch": (1500, "compiled", 1024),
        "whole environment, best batch": (700, "eager", 64),
        "whole environment, batch 1, eager": (1.2, "eager", 1),
    }


def test_cost_that_doubles_with_the_size_grows_linearly():
    # Twenty decisions of the whole batch in each turn.
    rows = [
        row(PHYSICS, 1, part="batch", batch=batch, wall_s=batch / 1024, decisions=20 * batch)
        for batch in (1024, 2048, 4096)
    ]
    (growth,) = scaling(rows)
    assert growth["milliseconds"] == pytest.approx([50, 100, 200])
    assert growth["exponent"] == pytest.approx(1)
