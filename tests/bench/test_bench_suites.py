"""The suites: what takes turns in their groups, and what follows from the rows."""

from __future__ import annotations

import time
from importlib.metadata import version

import pytest
import torch

from ganlane.bench import suites
from ganlane.bench.measure import measure
from ganlane.bench.suites import (
    ENVIRONMENT,
    PHYSICS,
    TRAFFIC,
    TRAINING,
    SimSuite,
    TrafficSuite,
    TrainSuite,
)
from ganlane.settings.commands import BenchConfig
from ganlane.settings.env import EnvConfig
from ganlane.settings.traffic import IdmTrafficConfig, TrafficConfig
from ganlane.data import SyntheticTraffic, synthetic_scenes, write_scene_csv
from ganlane.errors import UserError
from ganlane.settings.agent import RainbowConfig

SHORT = {"repetitions": 2, "seconds": 0.001}
RAINBOW = RainbowConfig(
    hidden=(16, 16), batch_size=32, decisions_per_update=8, capacity=512, warmup=64
)


def suite(kind=SimSuite, **options):
    usual = {
        "traffic": IdmTrafficConfig(),
        "memory": False,
        "modes": ["eager"],
        "threads": [1],
        "devices": ["cpu"],
    }
    usual |= {
        "train_batches": [16],
        "train_stored": 64,
        "train_traffics": ["idm_mobil", "idm"],
        "agent": RAINBOW,
    }
    return kind(BenchConfig(**{**usual, "peers": False, **options}))


@pytest.mark.parametrize(
    ("kind", "system", "option", "traffics", "modes"),
    [
        (TrafficSuite, TRAFFIC, "traffics", ["idm", "gan"], ["eager", "compiled"]),
        (
            TrainSuite,
            TRAINING,
            "train_traffics",
            ["idm_mobil", "idm"],
            ["eager", "compiled", "native"],
        ),
    ],
)
def test_every_traffic_takes_turns_in_every_mode_batch_and_thread_count(
    kind, system, option, traffics, modes
):
    options = {f"{kind.name}_batches": [2, 4], option: traffics}
    groups = suite(kind, **options, modes=modes, threads=[1, 2]).groups()
    assert [(group.threads, group.cases[0].labels.batch) for group in groups] == [
        (1, 2),
        (1, 4),
        (2, 2),
        (2, 4),
    ]
    seen = [(case.labels.system, case.labels.traffic, case.labels.mode) for case in groups[0].cases]
    assert seen == [(system, traffic, mode) for traffic in traffics for mode in modes]
    assert groups[0].reference is None


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
    growth = {
        group.title: [case.labels for case in group.cases]
        for group in groups
        if "growth" in group.title
    }
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

    monkeypatch.setattr(
        suites, "_START", dict.fromkeys((PHYSICS, ENVIRONMENT, suites.GYMNASIUM), start)
    )
    measured = suite(batches=[1, 2], vehicle_counts=[9], modes=["eager", "compiled"], linear_from=4)
    rows = measure(measured, **SHORT)["rows"]
    assert {row["mode"] for row in rows} == {"eager"}
    assert measured.notes.count("compile=true: needs a C++ compiler; install one.") == 1


def test_cost_that_doubles_with_the_size_grows_linearly():
    # Twenty decisions of the whole batch in each turn.
    rows = [
        {
            "part": "batch",
            "system": PHYSICS,
            "batch": batch,
            "wall_s": batch / 1024,
            "decisions": 20 * batch,
        }
        for batch in (1024, 2048, 4096)
    ]
    (growth,) = suites.scaling(rows)
    assert growth["milliseconds"] == pytest.approx([50, 100, 200])
    assert growth["exponent"] == pytest.approx(1)
    assert suites.exponent([9, 15, 30], [0.3 * size**1.7 for size in (9, 15, 30)]) == pytest.approx(
        1.7
    )
    assert suites.exponent([9, 9], [1.0, 2.0]) is None


def test_without_the_peer_a_sentence_says_what_to_install(monkeypatch):
    monkeypatch.setattr(suites, "installed_version", lambda package: None)
    measured = suite(batches=[2], vehicle_counts=[2], peers=True)
    assert any("pip install" in note for note in measured.notes)
    numbers = measure(measured, **SHORT)
    assert numbers["ratios"] == []
    assert [row["ratio"] for row in numbers["rows"]] == [None, None]
    training = suite(TrainSuite, peers=True)
    assert "stable-baselines3" in training.notes[0]
    assert training.groups()[0].reference is None


def test_the_peer_takes_turns_in_every_group_and_makes_one_row(monkeypatch):
    pytest.importorskip(
        "highway_env", reason="highway-env is not installed; it comes with the extra 'bench'"
    )
    monkeypatch.setattr(
        suites, "installed_version", lambda name: None if name == "envpool" else version(name)
    )
    measured = suite(batches=[1, 2], vehicle_counts=[9], linear_from=4, peers=True)
    labels = measured.peer().labels
    assert (labels.vehicles, labels.lanes, labels.batch) == (9, 3, 1)
    numbers = measure(measured, **SHORT)
    peer, *ours = numbers["rows"]
    assert peer["system"] == labels.system
    assert (peer["repetitions"], peer["ratio"]) == (2 * SHORT["repetitions"], 1.0)
    assert [row["system"] for row in ours] == [PHYSICS, ENVIRONMENT] * 2
    assert all(row["ratio"] > 0 for row in ours)
    assert [row["system"] for row in numbers["ratios"]] == [PHYSICS, ENVIRONMENT]


def test_steps_of_a_traffic_are_counted_as_they_are_driven():
    measured = suite(TrafficSuite, traffics=["idm", "gan"], traffic_batches=[3])
    assert measured.groups()[0].cases[0].start()(2) == 2 * 10 * 3
    numbers = measure(measured, **SHORT)
    assert [row["traffic"] for row in numbers["speeds"]] == ["idm", "gan"]
    (table,) = measured.tables(numbers["rows"], numbers)
    assert len(table.lines) == 2


def test_a_training_has_rows_and_the_best_of_each_traffic():
    measured = suite(TrainSuite)
    numbers = measure(measured, **SHORT)
    assert {row["system"] for row in numbers["rows"]} == {TRAINING}
    assert [row["traffic"] for row in numbers["rows"]] == ["idm_mobil", "idm"]
    assert [speed["times_peer"] for speed in numbers["speeds"]] == [None, None]
    assert [len(table.lines) for table in measured.tables(numbers["rows"], numbers)] == [2, 2]


def test_each_traffic_is_compared_at_its_best_with_the_peer_at_its_best():
    rates = {
        (TRAINING, "idm_mobil"): [4000, 6000],
        (TRAINING, "gan"): [1500],
        ("peer", "its own"): [60, 50],
    }
    rows = [
        {"system": system, "traffic": traffic, "device": "cpu", "decisions_per_s": rate}
        for (system, traffic), each in rates.items()
        for rate in each
    ]
    assert [row["times_peer"] for row in suite(TrainSuite).findings(rows)["speeds"]] == [
        100.0,
        25.0,
    ]


def test_quick_is_small_and_trains_eagerly():
    quick = BenchConfig(suite="train", quick=True).shortened()
    assert (quick.train_batches, quick.train_stored, quick.modes) == ([64], 1000, ["eager"])
    assert BenchConfig(quick=True).shortened().modes == ["eager", "compiled", "native"]
