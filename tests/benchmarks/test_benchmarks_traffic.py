"""The suite of the traffic: what takes turns, what the baselines compute, and what follows from rows."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

from ganlane.benchmarks import Budget, measure
from ganlane.benchmarks import traffic as traffic_module
from ganlane.benchmarks.traffic import TrafficOptions, TrafficSuite, start_traffic
from ganlane.benchmarks.traffic_findings import PADDED, SCENE_LOOP, SCENE_LOOP_ONCE, SYSTEM, ratios, speeds
from ganlane.config.bench import BenchConfig
from ganlane.config.env import EnvConfig
from ganlane.config.traffic import GanTrafficConfig, IdmTrafficConfig
from ganlane.errors import UserError
from ganlane.generator import GeneratorSizes

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks import sgan_padded, sgan_scene_loop

TRAFFICS = {"idm": IdmTrafficConfig(), "gan": GanTrafficConfig()}
SMALL = GeneratorSizes(embedding=6, hidden=5, pooling=4, pooled=3, context=6, noise=2)


def suite(**options):
    return TrafficSuite(TrafficOptions(EnvConfig(), **{"traffics": TRAFFICS, "batches": (2,), **options}))


def test_every_traffic_takes_turns_with_the_baselines_in_every_mode_batch_and_thread_count():
    groups = suite(batches=(2, 4)).groups()
    assert [(group.threads, group.cases[0].labels.batch) for group in groups] == [(1, 2), (1, 4), (2, 2), (2, 4)]
    seen = [(case.labels.system, case.labels.traffic, case.labels.mode) for case in groups[0].cases]
    assert len(seen) == len(set(seen)) == 2 * 2 + 3
    assert {system for system, _, _ in seen} == {SYSTEM, SCENE_LOOP, SCENE_LOOP_ONCE, PADDED}


def test_a_run_has_a_row_for_each_and_the_ratios_of_the_generated_traffic():
    measured = suite(modes=("eager",), threads=(1,))
    numbers = measure(measured, Budget(repetitions=2, seconds=0.001))
    assert [row["traffic"] for row in numbers["rows"]] == ["idm", "gan", *["Social-GAN"] * 3]
    assert all(row["physics_steps_per_s"] > 0 for row in numbers["rows"])
    assert {ratio["traffic"] for ratio in numbers["ratios"]} == {"gan"}
    titles = [table.title for table in measured.tables(numbers["rows"], numbers)]
    assert len(titles) == 2


def test_without_a_checkout_a_sentence_says_what_is_missing(monkeypatch, tmp_path):
    monkeypatch.setattr(traffic_module, "_FOLDER", tmp_path)
    alone = suite(modes=("eager",), threads=(1,))
    assert [case.labels.system for case in alone.groups()[0].cases] == [SYSTEM] * 2
    assert "checkout" in alone.notes[0]
    assert suite(peers=False).notes == []


def test_steps_are_counted_as_they_are_driven():
    run = start_traffic(suite()._scenario(IdmTrafficConfig()), "eager", 3)
    assert run(2) == 2 * 10 * 3


@pytest.mark.parametrize("pool_every_step", [True, False])
def test_the_scene_loop_treats_every_scene_as_if_it_were_alone(pool_every_step):
    torch.manual_seed(0)
    network = sgan_scene_loop.SceneLoopGenerator(SMALL, pool_every_step)
    network.with_noise = lambda context, ends: torch.cat([context, torch.zeros(len(context), SMALL.noise)], dim=1)
    moves, where = torch.randn(8, 5, 2), torch.randn(5, 2)
    together = network(moves, where, [(0, 2), (2, 5)])
    torch.testing.assert_close(together[:, 2:], network(moves[:, 2:], where[2:], [(0, 3)]))
    assert together.shape == (8, 5, 2)


def test_padding_changes_nobodys_pooling():
    torch.manual_seed(0)
    network = sgan_padded.PaddedGenerator(SMALL)
    hidden, where = torch.randn(2, 4, 5), torch.randn(2, 4, 2)
    valid = torch.tensor([[True, True, True, False]] * 2)
    pooled = network.pooled(hidden, where, valid)[:, :3]
    torch.testing.assert_close(pooled, network.pooled(hidden[:, :3], where[:, :3], valid[:, :3]))


@pytest.mark.parametrize("start", [sgan_padded.start, sgan_scene_loop.start])
def test_a_baseline_moves_every_vehicle_and_counts_its_steps(start):
    torch.manual_seed(0)
    loop = start(3, 4)
    before = loop.position.clone()
    assert loop(2) == 2 * 10 * 3
    assert (loop.position != before).any(-1).all()
    assert torch.isfinite(loop.position).all()


def row(system, rate, traffic="Social-GAN", **labels):
    figures = {"physics_steps_per_s": rate, "physics_steps_per_cpu_s": rate / 2}
    return {"system": system, "traffic": traffic, "mode": "eager", "threads": 1, "batch": 1, **figures, **labels}


def test_each_counts_at_its_best():
    rows = [
        row(SYSTEM, 900, "gan", threads=2),
        row(SYSTEM, 600, "gan"),
        row(SYSTEM, 5000, "idm"),
        row(SCENE_LOOP, 30),
        row(SCENE_LOOP, 20, threads=2),
        row(PADDED, 100),
    ]
    found = {(ratio["baseline"], ratio["required"]): ratio["ratio"] for ratio in ratios(rows)}
    assert found == {(SCENE_LOOP, 20.0): 30.0, (PADDED, 3.0): 9.0}
    assert [best["physics_steps_per_s"] for best in speeds(rows)] == [900, 5000, 30, 100]


def test_a_traffic_that_is_none_is_refused():
    with pytest.raises(UserError, match="traffics=nobody"):
        BenchConfig(traffics=["nobody"])
