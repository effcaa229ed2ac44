"""What is made of the episodes of a matrix, on episodes made by hand."""

import numpy as np
import polars as pl
import pytest
from reference.driven_episodes import KM, driven
from reference.refusals import user_error
from scipy import stats

from ganlane.settings.suite import Suite
from ganlane.suite.scores import by_recipe, comparisons, recipe_of, rows, summaries


def table_of(*episodes):
    return by_recipe(pl.concat(episodes))


@pytest.fixture(scope="module")
def matrix():
    """Two trainings of a recipe, MOBIL and the random driver.

    The first training crashes and leaves the road once.
    """
    mobil = ["goal", "goal", "goal", "hard_crash"]
    idm = ["hard_crash", "out_of_road", "goal", "goal"]
    return table_of(
        driven("random_legal", [0, 0, 1, 0]),
        driven("mobil", [100, 100, 101, 100], mobil, at_fault=False),
        driven("agent_idm@0", [120, 120, 121, 120], idm, at_fault=True),
        driven("agent_idm@1", [140, 140, 141, 140]),
    )


def row_of(matrix, driver):
    return next(row for row in rows(matrix) if row["driver"] == driver)


def test_a_recipe_is_its_drivers_without_their_seeds():
    assert recipe_of("agent_idm@3+safe") == "agent_idm+safe"
    assert recipe_of("some/folder/agent_idm.safetensors@12+safe") == "agent_idm+safe"
    assert recipe_of("agent_idm+none") == "agent_idm+none"
    assert recipe_of("outputs/a@b/mine.safetensors") == "outputs/a@b/mine.safetensors"


def test_a_row_holds_the_trainings_together_and_each_alone(matrix):
    row = row_of(matrix, "agent_idm")
    assert (row["trainings"], row["episodes"]) == (2, 4)
    # Two trainings that lead by 20 and 40: resampled, one of them twice at the most, as wide as two
    # tell of others.
    width = 10.0 * np.sqrt(2 / 1) * stats.t.ppf(0.975, 1) / stats.norm.ppf(0.975)
    assert row["minus_mobil_ci"] == pytest.approx([30.0 - width, 30.0 + width])
    expected = {
        "mean_reward": 130.25,
        "minus_mobil": 30.0,
        "probability_above_mobil": 1.0,
        "normalized_percent": 130.0,
        "mean_speed_mps": 25.0,
        "lane_changes_per_km": 2.0,
        "crashes_per_1000_km": 1000 / (8 * KM),
        "departures_per_1000_km": 1000 / (8 * KM),
        "failures_per_1000_km": 2000 / (8 * KM),
    }
    assert {name: row[name] for name in expected} == pytest.approx(expected)
    alone = [(training["mean_reward"], training["hard_crash"]) for training in row["each"]]
    assert alone == [(120.25, 1), (140.25, 0)]


def test_what_is_not_known_is_none(matrix):
    mobil, random_legal = row_of(matrix, "mobil"), row_of(matrix, "random_legal")
    assert mobil["minus_mobil"] is None
    # A single training has no probability, and no crash has no fault.
    assert random_legal["probability_above_mobil"] is random_legal["at_fault_share"] is None
    assert (row_of(matrix, "agent_idm")["at_fault_share"], mobil["at_fault_share"]) == (1.0, 0.0)


def test_drivers_are_compared_on_the_same_episodes_training_by_training(matrix):
    (row,) = comparisons(matrix, [("agent_idm", "mobil"), ("agent_idm", "nobody")])
    assert row["lead"] == pytest.approx(30.0)
    assert row["crash_difference_per_1000_episodes"] == pytest.approx(1000 * (1 / 8 - 1 / 4))
    first, second = row["mcnemar"]
    assert (first["only_first"], first["only_second"], first["p_value"]) == (1, 1, 1.0)
    assert (second["only_first"], second["only_second"]) == (0, 1)


def test_trainings_are_matched_by_their_seed():
    crash, goal = ["hard_crash", "goal"], ["goal", "goal"]
    trainings = {
        "agent_gan@0": goal,
        "agent_gan@1": crash,
        "agent_gan@4": goal,
        "agent_idm@2": goal,
        "agent_idm@1": crash,
    }
    frames = [driven(name, [0, 0], ends) for name, ends in trainings.items()]
    (row,) = comparisons(table_of(*frames), [("agent_gan", "agent_idm")])
    assert row["mcnemar"] == [
        {"driver": "agent_gan@1", "only_first": 0, "only_second": 0, "p_value": 1.0}
    ]


def test_two_drivers_that_never_crashed_may_still_differ():
    both = table_of(driven("mobil", [0] * 50), driven("keep_lane", [0] * 50))
    (row,) = comparisons(both, [("mobil", "keep_lane")])
    most = 1000 * (1 - 0.025 ** (1 / 50))  # the exact bound of 0 in 50
    assert row["crash_difference_per_1000_episodes_ci"] == pytest.approx([-most, most])


@pytest.mark.parametrize("other", ["mine/agent_idm.safetensors@2", "agent_idm"])
def test_two_agents_of_one_name_and_seed_are_not_mixed(other):
    with user_error("two of one seed are called agent_idm"):
        table_of(driven("agent_idm@2", [0, 0]), driven(other, [0, 0]))


def test_the_score_is_the_interquartile_mean_over_traffics_and_the_worst_is_named():
    suite = Suite(
        scored={"idm": 2, "idm_mobil": 2, "gan": 2, "human": 2}, baselines=["mobil_egoistic"]
    )
    rewards = {"idm": 110, "idm_mobil": 120, "gan": 40, "human": 300}
    parts = []
    for traffic, reward in rewards.items():
        parts += [
            driven("random_legal", [0, 0], traffic=traffic),
            driven("mobil", [100, 100], traffic=traffic),
            driven("mobil_egoistic", [105, 105], traffic=traffic),
            driven("mine@0", [reward - 4, reward], traffic=traffic, least_ttc_s=1.0),
            driven("mine@1", [reward, reward + 4], ["goal", "hard_crash"], traffic=traffic),
        ]
    cells = table_of(*parts)
    by_name = {entry["entry"]: entry for entry in summaries(cells, rows(cells), suite)}
    mine = by_name["mine"]
    assert mine["score"] == pytest.approx((110 + 120) / 2)
    low, high = mine["score_ci"]
    assert low < mine["score"] < high
    assert (mine["worst"], mine["worst_traffic"]) == (pytest.approx(40), "gan")
    assert (by_name["mobil"]["score"], by_name["random_legal"]["score"]) == (100.0, 0.0)
    assert by_name["mobil"]["score_ci"] == [100.0, 100.0]
    # Above on three traffics of four.
    assert mine["improvement"]["mobil"]["probability"] == 0.75
    assert mine["improvement"].keys() == {"random_legal", "mobil", "mobil_egoistic"}
    # One crash and two near misses on each traffic, in 4 episodes of 5 km.
    assert mine["crashes_per_1000_km"] == pytest.approx(1000 / (4 * KM))
    assert mine["near_misses_per_1000_km"] == pytest.approx(2000 / (4 * KM))
    assert mine["crash_kinds"] == {"run_into": 0, "cut_in": 4, "leaving": 0, "sitting": 0}


def test_replayed_episodes_of_one_recorded_car_are_one():
    # Of car 1 three episodes, of which one crashed; of car 2 one.
    ends, car = ["hard_crash", "goal", "goal", "goal"], [1, 1, 1, 2]
    mobil = driven("mobil", [0, 30, 60, 100], car=car)
    (_, row) = rows(table_of(mobil, driven("mine", [0, 30, 60, 120], ends, car=car)))
    assert row["episodes"] == 4
    assert row["mean_reward"] == pytest.approx((30 + 120) / 2)
    assert row["minus_mobil"] == pytest.approx(10)
    assert row["crashes_per_1000_km"] == pytest.approx(1000 * (1 / 3) / (2 * KM))
    assert row["hard_crash"] == 1


def test_a_published_suite_keeps_the_drivers_that_it_was_published_with():
    published = Suite(version="shift-v1", scored={"human": 10}).traffics()["human"]
    assert published.path.endswith("generator_human_1.safetensors")
    assert published.lane_changes == 1.8
    assert Suite(scored={"human": 10}).traffics()["human"].path is None
