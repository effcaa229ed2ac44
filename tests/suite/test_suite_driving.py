"""The comparison on recorded scenes: the scene of each episode, and what the record holds."""

import json

import polars as pl
import pytest
from reference.scene_csv import write_scene_csv
from reference.synthetic import SyntheticTraffic, synthetic_scenes

from ganlane.build import make_driver
from ganlane.commands.evaluate import publish
from ganlane.evaluation import crashes_by_scene, evaluation_rows, failed_episodes, paired_rows
from ganlane.evaluation.results import plain
from ganlane.settings.commands import EvaluateConfig
from ganlane.settings.env import EnvConfig
from ganlane.settings.traffic import IdmTrafficConfig, ReplayTrafficConfig
from ganlane.sim.random import Stream
from ganlane.suite.driving import compare
from ganlane.traffic import ReplayTraffic

EPISODES = 7


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    path = tmp_path_factory.mktemp("recordings") / "scenes.csv"
    write_scene_csv(synthetic_scenes(SyntheticTraffic(scenes=3, seconds=7.0), seed=0), path)
    return path


@pytest.fixture(scope="module")
def table(recordings):
    env = EnvConfig(goal_m=60.0)
    traffics = {"idm": IdmTrafficConfig(), "replay": ReplayTrafficConfig(path=str(recordings))}
    drivers = [make_driver(name, env) for name in ("keep_lane", "random_legal")]
    config = EvaluateConfig(
        env=env,
        traffics=traffics,
        seed=5,
        episodes=EPISODES,
        num_envs=4,
    )
    return compare(drivers, config)


def test_every_replayed_episode_has_the_scene_that_it_ran_in(table, recordings):
    scenes = ReplayTraffic(Stream.REPORT, recordings).scenes_of_episodes(5, range(EPISODES))
    assert len(set(scenes)) == 3
    replayed = table.filter(pl.col("traffic") == "replay")
    for _, episodes in replayed.group_by("agent"):
        assert episodes.sort("episode")["scene"].to_list() == scenes
    assert table.filter(pl.col("traffic") == "idm")["scene"].is_null().all()


def test_the_record_holds_rows_paired_leads_failures_and_crashes_by_scene(table, tmp_path, capsys):
    publish(table, tmp_path, {}, {})
    record = json.loads((tmp_path / "results.json").read_text())
    assert record["rows"] == plain(evaluation_rows(table))
    assert record["paired"] == plain(paired_rows(table))
    assert record["failures"] == failed_episodes(table)
    assert capsys.readouterr().out.count("keep_lane over random_legal") == 2
    assert [row["agent"] for row in record["crashes_by_scene"]] == ["keep_lane", "random_legal"]
    for row in record["crashes_by_scene"]:
        episodes = table.filter(traffic="replay", agent=row["agent"])
        per_km, scenes = crashes_by_scene(episodes, episodes["scene"].to_list())
        assert (row["per_km"], row["per_km_ci"]) == (per_km.value, per_km.interval)
        assert row["scenes"] == scenes


def test_other_traffics_have_no_scenes(table, tmp_path):
    publish(
        table.filter(pl.col("traffic") == "idm").drop("scene"),
        tmp_path,
        {},
        {},
    )
    assert "crashes_by_scene" not in json.loads((tmp_path / "results.json").read_text())
