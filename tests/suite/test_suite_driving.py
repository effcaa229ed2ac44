"""The comparison on recorded scenes: the scene of each episode, and what the record holds."""

import pytest
import torch
from reference.refusals import results_in

import ganlane
from ganlane.commands.evaluate import publish
from ganlane.evaluation import crashes_by_scene, evaluation_rows, failed_episodes, paired_rows
from ganlane.evaluation.results import as_json
from ganlane.settings.commands import EvaluateConfig
from ganlane.sim.random import Stream, episode_key
from ganlane.traffic import ReplayTraffic


@pytest.fixture(scope="module")
def table(three_scenes):
    traffics = {"idm": "idm", "replay": {"name": "replay", "path": str(three_scenes)}}
    options = {"per_episode": True, "seed": 5, "goal_m": 60.0, "num_envs": 4}
    return ganlane.api.evaluate(["keep_lane", "random_legal"], traffics, 7, **options)


def test_every_replayed_episode_has_the_scene_that_it_ran_in(table, three_scenes):
    traffic = ReplayTraffic(Stream.REPORT, three_scenes)
    for agent in ("keep_lane", "random_legal"):
        episodes = table.filter(traffic="replay", agent=agent)
        assert episodes["scene"].n_unique() == 3
        numbers = episodes["episode"].to_list()
        assert episodes["scene"].to_list() == traffic.scenes_of_episodes(5, numbers)
    assert table.filter(traffic="idm")["scene"].is_null().all()


def test_the_record_holds_rows_paired_leads_failures_and_crashes_by_scene(table, tmp_path, capsys):
    publish(table, tmp_path, EvaluateConfig(columns="all"), {})
    record = results_in(tmp_path)
    assert record["rows"] == as_json(evaluation_rows(table))
    assert record["paired"] == as_json(paired_rows(table))
    assert record["failures"] == failed_episodes(table)
    assert capsys.readouterr().out.count("keep_lane over random_legal") == 2
    assert [row["agent"] for row in record["crashes_by_scene"]] == ["keep_lane", "random_legal"]
    for row in record["crashes_by_scene"]:
        episodes = table.filter(traffic="replay", agent=row["agent"])
        per_km, scenes = crashes_by_scene(episodes, episodes["scene"].to_list())
        assert (row["per_km"], row["per_km_ci"]) == (per_km.value, per_km.interval)
        assert row["scenes"] == scenes


def test_no_recorded_start_is_driven_twice_however_many_episodes_are_asked_for(three_scenes):
    traffic = ReplayTraffic(Stream.REPORT, three_scenes)
    replay = {"name": "replay", "path": str(three_scenes)}
    table = ganlane.api.evaluate("keep_lane", [replay], 10_000, per_episode=True, goal_m=60.0)
    keys = episode_key(traffic.stream, torch.zeros(len(table)).long(), table["episode"].to_torch())
    assert 0 < len(table) <= len(traffic.starts)
    assert len(set(traffic.start_of(keys).tolist())) == len(table)


def test_other_traffics_have_no_scenes(table, tmp_path):
    publish(table.filter(traffic="idm").drop("scene"), tmp_path, EvaluateConfig(columns="all"), {})
    assert "crashes_by_scene" not in results_in(tmp_path)
