"""Drivers on other roads: every road is driven, the paper's as in the matrix itself."""

from __future__ import annotations

import json

from benchmarks import roads


def test_every_road_is_driven_and_an_agent_is_compared_with_mobil_on_the_same_one(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(roads, "ROADS", ((9, 3), (4, 2)))
    few = ["agents=[mobil,agent_idm@1+safe]", "traffics=[idm]", "episodes=2", "env.goal_m=60"]
    assert roads.main([*few, f"cells={tmp_path}/cells", "--out", str(tmp_path / "out")]) == 0
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    places = [
        (row["vehicles"], row["lanes"], row["driver"], row["episodes"]) for row in results["rows"]
    ]
    assert places == [
        (m, n, driver, 2) for m, n in roads.ROADS for driver in ("mobil", "agent_idm+safe")
    ]
    leads = [row["minus_mobil"] for row in results["rows"]]
    means = [row["mean_reward"] for row in results["rows"]]
    assert leads[0] is leads[2] is None
    assert [leads[1], leads[3]] == [means[1] - means[0], means[3] - means[2]]
    assert means[0] != means[2]
    assert results["seeds"]["episodes"] == {"idm": 2}


def test_the_papers_road_is_that_of_the_matrix_and_others_keep_its_density():
    from ganlane.config.command_line import check

    assert roads.config_of(*roads.ROADS[0], []).env == check("reproduce", []).config.env
    many = roads.config_of(30, 3, []).env
    assert many.spread_m / many.vehicles == 22.3


def test_an_option_that_there_is_not_is_refused_in_a_sentence(tmp_path, capsys):
    assert roads.main(["episods=3", "--out", str(tmp_path)]) == 2
    assert "episods" in capsys.readouterr().err
