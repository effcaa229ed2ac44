"""The comparison on recorded scenes: the scene of each episode, and what the record holds."""

from __future__ import annotations

import json

import polars as pl
import pytest

from ganlane.build import make_driver
from ganlane.compare import compare, publish, recorded_crashes
from ganlane.settings.commands import EvaluateConfig
from ganlane.settings.env import EnvConfig
from ganlane.settings.traffic import IdmTrafficConfig, ReplayTrafficConfig
from ganlane.data import SyntheticTraffic, synthetic_scenes, write_scene_csv
from ganlane.evaluation import crashes_by_scene, failed_episodes
from ganlane.sim.random import Stream
from ganlane.traffic import ReplayTraffic

EPISODES = 12


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
    options = {
        "traffics": list(traffics),
        "traffic_options": traffics,
        "episodes": EPISODES,
        "num_envs": 4,
    }
    return compare(drivers, EvaluateConfig(env=env, seed=5, **options))


def test_every_replayed_episode_has_the_scene_that_it_ran_in(table, recordings):
    scenes = ReplayTraffic(Stream.REPORT, recordings).scenes_of_episodes(5, range(EPISODES))
    assert len(set(scenes)) == 3
    for agent in ("keep_lane", "random_legal"):
        episodes = table.filter(pl.col("traffic") == "replay", pl.col("agent") == agent).sort(
            "episode"
        )
        assert episodes["scene"].to_list() == scenes
    assert table.filter(pl.col("traffic") == "idm")["scene"].is_null().all()


def test_the_record_holds_rows_paired_leads_and_crashes_by_scene(table, tmp_path, capsys):
    publish(table, tmp_path, {}, {})
    record = json.loads((tmp_path / "results.json").read_text())
    assert len(record["rows"]) == 4
    assert [
        (row["agent"], row["over"], row["traffic"], row["episodes"]) for row in record["paired"]
    ] == [
        ("keep_lane", "random_legal", "idm", EPISODES),
        ("keep_lane", "random_legal", "replay", EPISODES),
    ]
    assert capsys.readouterr().out.count("keep_lane over random_legal") == 2
    means = {(row["agent"], row["traffic"]): row["mean_reward"] for row in record["rows"]}
    for row in record["paired"]:
        lead = means["keep_lane", row["traffic"]] - means["random_legal", row["traffic"]]
        assert row["lead"] == pytest.approx(lead)
        assert row["lead_ci"][0] <= row["lead"] <= row["lead_ci"][1]
    assert record["failures"] == failed_episodes(table)
    assert [row["agent"] for row in record["crashes_by_scene"]] == ["keep_lane", "random_legal"]
    for row in record["crashes_by_scene"]:
        own = table.filter(pl.col("traffic") == "replay", pl.col("agent") == row["agent"])
        expected = crashes_by_scene(own, own["scene"].to_list())
        assert row["traffic"] == "replay"
        assert row["per_km"] == pytest.approx(expected.per_km.value)
        assert row["per_km_ci"] == pytest.approx(expected.per_km.interval)
        assert sum(scene["episodes"] for scene in row["scenes"]) == EPISODES
        assert sum(scene["distance_km"] for scene in row["scenes"]) == pytest.approx(
            own["distance_m"].sum() / 1000
        )


def test_other_traffics_have_no_scenes(table, tmp_path):
    others = table.filter(pl.col("traffic") == "idm").drop("scene")
    assert recorded_crashes(others) == []
    publish(others, tmp_path, {}, {})
    assert "crashes_by_scene" not in json.loads((tmp_path / "results.json").read_text())
