"""An evaluation's numbers, entry by entry, from hand-made episodes."""

from itertools import product

import numpy as np
import polars as pl
import pytest
from reference.driven_episodes import driven
from reference.refusals import user_error

from ganlane.evaluation import (
    crashes_by_scene,
    evaluation_rows,
    failed_episodes,
    normalized_percent,
    paired_rows,
    paired_table,
    text_table,
)
from ganlane.evaluation.rows import verdict
from ganlane.evaluation.statistics import mean_interval


@pytest.fixture(scope="module")
def rows():
    ends = ["goal", "timeout", "hard_crash", "out_of_road"]
    # Three soft crashes in the first episode.
    soft = {"soft_crash": [3, 0, 0, 0], "had_soft_crash": [True, False, False, False]}
    return evaluation_rows(
        pl.concat(
            [
                driven("agent_idm", [20, 24, -80, 26], ends, **soft),
                driven("mobil", [30, 32, 34, 36]),
                driven("random_legal", [-10, -8, -6, -4]),
            ]
        )
    )


def test_ends_are_counted_once_and_soft_crashes_by_episode(rows):
    expected = {
        "agent": "agent_idm",
        "traffic": "idm",
        "episodes": 4,
        "goal": 1,
        "hard_crash": 1,
        "out_of_road": 1,
        "timeout": 1,
        "scene_end": 0,
        "soft_crash": 1,
        "soft_crash_onsets": 3,
        "soft_crash_behind_onsets": 4,
        "soft_crash_behind_per_episode": 1.0,
        "soft_crash_behind_per_episode_ci": [1.0, 1.0],
    }
    assert {name: rows[0][name] for name in expected} == expected


def test_rates_relate_to_the_distance_of_all_episodes(rows):
    expected = {
        "distance_km": 20.0,
        "mean_speed_mps": 25.0,
        "lane_changes_per_km": 40 / 20,
        "crashes_per_1000_km": 50.0,
        "hard_crash_share": 0.25,
        "out_of_road_share": 0.25,
    }
    assert {name: rows[0][name] for name in expected} == pytest.approx(expected)
    # Garwood's bounds for one event, and Clopper and Pearson's for one of four.
    assert rows[0]["crashes_per_1000_km_ci"] == pytest.approx([0.0253 * 50, 5.572 * 50], abs=0.1)
    for name in ("hard_crash_share_ci", "out_of_road_share_ci"):
        assert rows[0][name] == pytest.approx([0.0063, 0.8059], abs=1e-3)


def test_the_score_runs_from_random_to_mobil(rows):
    # The agent's mean is -2.5, MOBIL's 33, the random driver's -7.
    scores = [row["normalized_percent"] for row in rows]
    assert scores == pytest.approx([100 * 4.5 / 40, 100.0, 0.0])
    assert rows[1]["normalized_percent_ci"] == pytest.approx([100.0, 100.0])


def test_a_scale_without_a_length_gives_no_score():
    score, reason = normalized_percent([5, 6, 7, 8], [1, -2, 3, -1], [0] * 4)
    assert score is None
    assert "includes 0" in reason


def test_drivers_are_paired_by_episode_whatever_their_order():
    mobil = driven("mobil", [30, 32, 34, 36])
    random_legal = driven("random_legal", [0, 2, 4, 6])
    agent = driven("a", [15, 17, 19, 21])
    # The agent stands half-way in every single episode: no doubt is left.
    expected = {
        "normalized_percent": 50.0,
        "normalized_percent_ci": [50.0, 50.0],
        "minus_mobil": -15.0,
        "minus_mobil_ci": [-15.0, -15.0],
    }
    for order in (agent, agent.reverse()):
        row, mobils, _ = evaluation_rows(pl.concat([order, mobil, random_legal.reverse()]))
        for name, value in expected.items():
            assert row[name] == pytest.approx(value)
        assert mobils["minus_mobil"] is None


def test_without_the_drivers_of_the_scale_a_reason_replaces_the_score_and_nobody_leads_mobil():
    tables = [driven("a", [1, 2, 3], traffic=name) for name in ("idm", "gan")]
    rows = evaluation_rows(pl.concat(tables))
    assert [row["traffic"] for row in rows] == ["idm", "gan"]
    assert rows[0]["normalized_percent"] is rows[0]["minus_mobil"] is None
    assert "mobil is missing" in rows[0]["normalized_percent_reason"]
    text = text_table(rows)
    assert text.splitlines()[-1].startswith("% of MOBIL on idm, gan: none, needs mobil")
    assert "minus MOBIL" not in text


@pytest.mark.filterwarnings("error")
def test_resamples_without_a_lead_do_not_spoil_the_interval():
    # In the first episode MOBIL leads by nothing: a resample of it alone has no scale. In the
    # others the agent is half way from random to MOBIL.
    mobil, random_legal = [10.0, 20.0, 30.0, 40.0], [10.0, 0.0, 0.0, 0.0]
    score, _ = normalized_percent([10.0, 10.0, 15.0, 20.0], mobil, random_legal)
    assert score.value == pytest.approx(100.0 * 45.0 / 90.0)
    assert score.interval == pytest.approx([50.0, 50.0])


def test_the_first_driver_is_held_against_every_other_on_every_traffic():
    tables = [
        driven(agent, [base, base + 1.0] * 15, traffic=traffic)
        for traffic in ("idm", "gan")
        for agent, base in (("trained", 5.0), ("mobil", 7.0), ("keep_lane", 1.0))
    ]
    names = ("agent", "episodes", "traffic", "over", "lead", "verdict")
    told = [tuple(row[name] for name in names) for row in paired_rows(pl.concat(tables))]
    assert told == [
        ("trained", 30, traffic, *lead)
        for traffic in ("idm", "gan")
        for lead in (("mobil", -2.0, "below"), ("keep_lane", 4.0, "above"))
    ]


def lead_of(differences, failed=0):
    """The row of a driver that leads one of return 0 by ``differences``; the first ``failed``
    crashed.
    """
    reasons = ["hard_crash"] * failed + ["goal"] * (len(differences) - failed)
    ours = driven("a", differences, reasons)
    (row,) = paired_rows(pl.concat([ours, driven("b", [0.0] * len(differences))]))
    return row


def verdict_of(differences, failed=0):
    return lead_of(differences, failed)["verdict"]


def test_there_is_no_verdict_below_30_episodes():
    lead = [4.0, 5.0, 6.0]
    assert verdict_of(lead * 10) == "above"
    assert verdict_of(lead * 9 + lead[:2]) == "undecided"


def test_a_verdict_does_not_hang_on_few_crashes():
    rest = [3.0, -3.0] * 60
    # Four crashes move the whole interval to one side, and are no evidence.
    four = [-240.0] * 4 + rest
    assert lead_of(four)["lead_ci"][1] < 0.0
    assert verdict_of(four, failed=4) == "undecided"
    assert verdict_of([-240.0] * 9 + rest, failed=9) == "below"
    # Nor do few crashes that say nothing new take a verdict away.
    assert verdict_of([-10.0] * 3 + [-3.0, -4.0] * 60, failed=3) == "below"


def simulated(generator, count, crash_rate, noise):
    """Returns [E] of two equal drivers on the same episodes, and which of them crashed."""
    shared = generator.normal(240.0, 15.0, count)
    returns, crashed = [], []
    for _ in range(2):
        crash = generator.random(count) < crash_rate
        safe = shared + generator.normal(0.0, noise, count)
        returns.append(np.where(crash, generator.uniform(-40.0, 150.0, count), safe))
        crashed.append(crash)
    return returns, crashed


@pytest.mark.slow
@pytest.mark.parametrize("noise", [3.0, 15.0])
@pytest.mark.parametrize("crash_rate", [0.003, 0.01, 0.06, 0.2])
@pytest.mark.parametrize("count", [30, 50, 100, 300])
def test_equal_drivers_get_a_verdict_in_at_most_6_of_100_comparisons(count, crash_rate, noise):
    generator = np.random.default_rng(1)
    false = 0
    for _ in range(1500):
        (first, second), (one, other) = simulated(generator, count, crash_rate, noise)
        lead = mean_interval(first - second)
        false += verdict(lead, first - second, one != other) != "undecided"
    # The interval alone gives up to 23 of 100.
    assert false <= 0.06 * 1500


def test_a_single_driver_and_a_single_episode_give_no_pairs():
    assert paired_rows(driven("a", [1, 2])) == []
    assert paired_rows(pl.concat([driven("a", [1]), driven("b", [2])])) == []


def test_the_table_gives_the_sign_the_interval_and_the_verdict():
    row = {"agent": "trained", "over": "mobil", "traffic": "gan", "episodes": 200}
    above = {**row, "lead": 12.34, "lead_ci": [4.51, 20.1], "verdict": "above"}
    below = {**row, "lead": -3.0, "lead_ci": [-5.0, -1.0], "verdict": "below"}
    heading, _, first, second = paired_table([above, below]).splitlines()
    assert " ".join(heading.split()) == "paired lead traffic reward [95 %] verdict"
    assert first.split(maxsplit=4)[-1] == "+12.3 [4.5, 20.1]    above"
    assert second.split(maxsplit=4)[-1] == "-3.0 [-5.0, -1.0]    below"
    few = {**below, "episodes": 29, "verdict": "undecided"}
    assert paired_table([above, few]).splitlines()[-1] == "no verdict below 30 episodes"


def by_scene(*scenes):
    """The numbers of scenes, each as (name, episodes, crashes, m per episode)."""
    names, ends = [], []
    for scene, count, crashes, metres in scenes:
        names += [scene] * count
        ends += [("hard_crash", metres)] * crashes + [("goal", metres)] * (count - crashes)
    table = pl.DataFrame(ends, schema=["reason", "distance_m"], orient="row")
    return crashes_by_scene(table, names)


def test_the_rate_is_all_crashes_over_all_kilometres():
    per_km, rows = by_scene(("b", 10, 1, 100.0), ("a", 5, 3, 400.0))
    assert per_km.value == pytest.approx(4 / 3.0)
    # Garwood's exact bounds for one event.
    assert rows[1]["crashes_per_km_ci"] == pytest.approx([0.0253, 5.572], abs=1e-3)
    names = ("scene", "episodes", "hard_crash", "distance_km", "crashes_per_km")
    told = [tuple(row[name] for name in names) for row in rows]
    assert told == [("a", 5, 3, 2.0, 1.5), ("b", 10, 1, 1.0, 1.0)]


@pytest.mark.parametrize("times", [1, 10])
def test_the_interval_is_that_of_all_resamples_of_the_scenes_however_many_episodes(times):
    crashes, km = np.array([2.0, 0.0, 5.0]), np.array([1.0, 3.0, 2.0])
    # All 27 resamples of three scenes are equally likely.
    resamples = [list(drawn) for drawn in product(range(3), repeat=3)]
    ratios = [crashes[drawn].sum() / km[drawn].sum() for drawn in resamples]
    low, high = np.quantile(np.repeat(ratios, 1000), [0.025, 0.975])
    n = 10 * times
    per_km, _ = by_scene(("a", n, 2 * times, 100.0), ("b", n, 0, 300.0), ("c", n, 5 * times, 200.0))
    assert per_km.interval == pytest.approx([low, high])
    assert (low, high) == pytest.approx((0.0, 2.5))


def test_no_crash_is_not_certainty():
    per_km, _ = by_scene(("a", 10, 0, 100.0), ("b", 10, 0, 100.0))
    assert (per_km.value, per_km.low) == (0.0, 0.0)
    assert per_km.high == pytest.approx(3.689 / 2.0, abs=1e-3)


def test_one_scene_has_no_interval_and_one_without_distance_no_rate():
    assert by_scene(("a", 10, 1, 100.0))[0].interval is None
    per_km, rows = by_scene(("a", 10, 1, 100.0), ("b", 1, 0, 0.0))
    assert rows[1]["crashes_per_km"] is None
    assert np.isfinite(per_km.interval).all()


def test_what_does_not_fit_together_is_refused():
    with user_error("2 scenes for 3 episodes"):
        crashes_by_scene(driven("a", [0, 0, 0]), ["a", "a"])
    with user_error("nobody drove"):
        by_scene(("a", 3, 0, 0.0))


def test_every_failure_is_listed_with_its_seed_and_episode():
    ends = ["hard_crash", "goal", "out_of_road"]
    (row,) = failed_episodes(driven("mobil", [0, 0, 0], ends, "gan"))
    assert (row["driver"], row["traffic"], row["seed"]) == ("mobil", "gan", 7)
    assert (row["hard_crash"], row["out_of_road"]) == ([0], [2])
