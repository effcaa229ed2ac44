"""The evaluation's table, entry by entry, from hand-made episodes."""

from __future__ import annotations

import polars as pl
import pytest

from ganlane.evaluation import evaluation_rows, markdown_table, normalized_percent, text_table


def episodes(agent, rewards, reasons=None, traffic="idm"):
    """Episodes of 5000 m in 200 s with two lane changes each."""
    n = len(rewards)
    reasons = reasons or ["goal"] * n
    return pl.DataFrame(
        {
            "agent": [agent] * n,
            "traffic": [traffic] * n,
            "episode": range(n),
            "seed": [7] * n,
            "reason": reasons,
            "soft_crash": [3 if i == 0 else 0 for i in range(n)],
            "had_soft_crash": [i == 0 for i in range(n)],
            "soft_crash_behind": [1] * n,
            "reward": [float(reward) for reward in rewards],
            "decisions": [200] * n,
            "duration_s": [200.0] * n,
            "distance_m": [5000.0] * n,
            "mean_speed_mps": [25.0] * n,
            "lane_changes": [2] * n,
        }
    )


@pytest.fixture
def rows():
    agent = episodes("agent_idm", [20, 24, -80, 26], ["goal", "timeout", "hard_crash", "out_of_road"])
    mobil = episodes("mobil", [30, 32, 34, 36])
    random_legal = episodes("random_legal", [-10, -8, -6, -4])
    return evaluation_rows(pl.concat([agent, mobil, random_legal]))


def test_ends_are_counted_once_and_soft_crashes_by_episode(rows):
    row = rows[0]
    assert (row["agent"], row["traffic"], row["episodes"]) == ("agent_idm", "idm", 4)
    ends = {"goal": 1, "hard_crash": 1, "out_of_road": 1, "timeout": 1, "scene_end": 0}
    assert {name: row[name] for name in ends} == ends
    assert row["soft_crash"] == 1
    assert row["soft_crash_onsets"] == 3
    assert row["soft_crash_behind_onsets"] == 4
    assert row["soft_crash_behind_per_episode"] == 1.0
    assert row["soft_crash_behind_per_episode_ci"] == [1.0, 1.0]


def test_rates_relate_to_the_distance_of_all_episodes(rows):
    row = rows[0]
    assert row["distance_km"] == pytest.approx(20.0)
    assert row["mean_speed_mps"] == pytest.approx(25.0)
    assert row["lane_changes_per_km"] == pytest.approx(8 / 20)
    assert row["crashes_per_1000_km"] == pytest.approx(50.0)
    assert row["crashes_per_1000_km_ci"] == pytest.approx([0.0253 * 50, 5.572 * 50], abs=0.1)
    assert row["hard_crash_share"] == pytest.approx(0.25)
    assert row["hard_crash_share_ci"] == pytest.approx([0.0063, 0.8059], abs=1e-3)
    assert row["out_of_road_share"] == pytest.approx(0.25)
    assert row["out_of_road_share_ci"] == pytest.approx([0.0063, 0.8059], abs=1e-3)


def test_the_score_runs_from_random_to_mobil(rows):
    by_agent = {row["agent"]: row for row in rows}
    assert by_agent["mobil"]["normalized_percent"] == pytest.approx(100.0)
    assert by_agent["mobil"]["normalized_percent_ci"] == pytest.approx([100.0, 100.0])
    assert by_agent["random_legal"]["normalized_percent"] == pytest.approx(0.0)
    # The agent's mean is -2.5, MOBIL's 33, the random driver's -7.
    assert by_agent["agent_idm"]["normalized_percent"] == pytest.approx(100 * 4.5 / 40)


def test_the_form_of_the_score_fits_both_rows_of_the_papers_table():
    # R_0 = -25.0 and R_MOBIL = 26.0 are the two unknowns that Table VII's two rows determine.
    for reward, percent in ((-22.33, 5.21), (33.62, 114.82)):
        score = normalized_percent([reward] * 2, [26.0] * 2, [-25.0] * 2, resamples=10)
        assert score.percent == pytest.approx(percent, abs=0.15)


def test_the_score_is_computed_on_shared_episodes_whatever_their_order():
    mobil, random_legal = episodes("mobil", [30, 32, 34, 36]), episodes("random_legal", [0, 2, 4, 6])
    agent = episodes("a", [15, 17, 19, 21])
    straight = evaluation_rows(pl.concat([agent, mobil, random_legal]))[0]
    turned = evaluation_rows(pl.concat([agent.reverse(), mobil, random_legal.reverse()]))[0]
    assert straight["normalized_percent"] == turned["normalized_percent"] == pytest.approx(50.0)
    # Paired, the agent stands half-way in every single episode: no doubt is left.
    assert straight["normalized_percent_ci"] == pytest.approx([50.0, 50.0])


def test_without_the_drivers_of_the_scale_there_is_a_reason_in_place_of_a_score():
    row = evaluation_rows(pl.concat([episodes("a", [1, 2, 3]), episodes("mobil", [1, 2, 3])]))[0]
    assert row["normalized_percent"] is None
    assert "random_legal" in row["normalized_percent_reason"]


def test_a_scale_without_length_gives_no_score():
    score = normalized_percent([5.0, 6.0, 7.0, 8.0], [1.0, -2.0, 3.0, -1.0], [0.0, 0.0, 0.0, 0.0])
    assert score.percent is None
    assert "includes 0" in score.reason


def test_rows_keep_the_order_in_which_agents_and_traffics_came():
    frames = [episodes(agent, [1, 2], traffic=t) for t in ("idm", "gan") for agent in ("b", "a")]
    rows = evaluation_rows(pl.concat(frames))
    assert [(row["agent"], row["traffic"]) for row in rows] == [
        ("b", "idm"),
        ("a", "idm"),
        ("b", "gan"),
        ("a", "gan"),
    ]


def test_the_text_table_is_aligned_and_leaves_out_what_never_happened(rows):
    lines = text_table(rows).splitlines()
    assert len({len(line) for line in lines[:5]}) == 1
    assert "time-out" in lines[0]
    assert "scene end" not in lines[0]
    assert "agent_idm" in lines[2]
    assert "-2.5 [" in lines[2]


def test_a_missing_score_is_explained_below_the_table():
    rows = evaluation_rows(pl.concat([episodes("a", [1, 2, 3]), episodes("a", [1, 2, 3], traffic="gan")]))
    assert text_table(rows).splitlines()[-1].startswith("% of MOBIL on idm, gan: none, needs mobil")
    assert markdown_table(rows).splitlines()[-1].startswith("% of MOBIL on idm, gan: none, needs mobil")


def test_the_markdown_table_has_as_many_cells_in_every_line(rows):
    lines = markdown_table(rows).splitlines()
    assert len(lines) == 5
    assert len({line.count("|") for line in lines}) == 1
    assert set(lines[1]) <= set("|-: ")


def test_the_lead_over_mobil_is_paired_by_episode_whatever_their_order():
    mobil = episodes("mobil", [10, 200, 30, 400, 50])
    agent = episodes("agent", [13, 203, 33, 403, 53]).reverse()
    agent_row, mobil_row = evaluation_rows(pl.concat([agent, mobil]))
    assert agent_row["minus_mobil"] == pytest.approx(3.0)
    assert agent_row["minus_mobil_ci"] == pytest.approx([3.0, 3.0])
    assert mobil_row["minus_mobil"] is None


def test_without_mobil_nobody_has_a_lead_over_it():
    row = evaluation_rows(episodes("agent", [1, 2]))[0]
    assert row["minus_mobil"] is None
    assert "minus MOBIL" not in text_table([row])
