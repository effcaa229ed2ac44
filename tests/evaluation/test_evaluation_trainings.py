"""Statistics over trainings against hand-worked values, SciPy and known variances."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from ganlane.evaluation.statistics import (
    difference,
    interquartile_mean,
    mcnemar,
    over_trainings,
    poisson_interval,
    probability_of_improvement,
    rate_over_trainings,
)

NORMAL_WIDTH = 2 * 1.96


def scores(trainings, episodes, between=0.0, shared=0.0, own=0.0, seed=0):
    """Scores [S, E] that vary between trainings, between episodes (alike for all trainings), and otherwise."""
    generator = np.random.default_rng(seed)
    of_training = between * generator.normal(size=(trainings, 1))
    of_episode = shared * generator.normal(size=(1, episodes))
    return of_training + of_episode + own * generator.normal(size=(trainings, episodes))


def width(estimate):
    return estimate.high - estimate.low


def test_the_interquartile_mean_is_that_of_the_middle_half():
    assert interquartile_mean([100.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, -50.0]) == 4.5
    assert interquartile_mean([9.0, 1.0, 2.0, 3.0, 100.0]) == pytest.approx((2 + 3 + 9) / 3)
    assert interquartile_mean([[1.0, 3.0], [5.0, 7.0]]) == pytest.approx([2.0, 6.0])


def test_one_training_has_the_interval_of_its_episodes():
    table = scores(1, 400, own=10.0)
    estimate = over_trainings(table)
    assert estimate.value == pytest.approx(table.mean())
    assert width(estimate) == pytest.approx(NORMAL_WIDTH * table.std() / 20, rel=0.08)


def test_one_episode_has_the_interval_of_its_trainings():
    table = scores(200, 1, between=3.0)
    assert width(over_trainings(table)) == pytest.approx(NORMAL_WIDTH * table.std() / np.sqrt(200), rel=0.08)


def test_what_all_trainings_share_does_not_average_out_with_their_number():
    episodes = scores(1, 100, shared=10.0)
    alone, twenty = over_trainings(episodes), over_trainings(np.repeat(episodes, 20, axis=0))
    assert width(twenty) == pytest.approx(width(alone), rel=1e-9)


def test_a_recipe_whose_trainings_differ_has_a_wider_interval_than_its_episodes_alone():
    table = scores(5, 200, between=10.0, own=10.0, seed=1)
    assert width(over_trainings(table)) > 4 * width(over_trainings(table.reshape(1, -1)))
    of_means = stats.ttest_1samp(table.mean(axis=1), 0.0).confidence_interval()
    assert width(over_trainings(table)) == pytest.approx(of_means.high - of_means.low, rel=0.1)


@pytest.mark.parametrize("between", [0.0, 2.0, 20.0])
@pytest.mark.parametrize("trainings", [3, 5])
def test_an_interval_holds_the_truth_in_95_of_100_recipes(trainings, between):
    tables = [scores(trainings, 100, between=between, shared=10.0, own=10.0, seed=seed) for seed in range(200)]
    held = [estimate.low <= 0.0 <= estimate.high for estimate in map(over_trainings, tables)]
    # The plain bootstrap of three holds it in three quarters of them where trainings differ by 20.
    assert 0.91 <= np.mean(held) <= 0.99


def test_a_difference_pairs_the_episodes():
    episodes = scores(1, 300, shared=50.0)
    better = episodes + 5.0 + scores(4, 300, own=0.1)
    estimate = difference(better, episodes)
    assert estimate.value == pytest.approx(5.0, abs=0.02)
    assert width(estimate) < 0.1


def test_a_difference_of_two_recipes_resamples_the_trainings_of_both():
    first, second = scores(6, 1, between=1.0), scores(6, 1, between=1.0, seed=2)
    theirs = stats.ttest_ind(first[:, 0], second[:, 0], equal_var=False).confidence_interval()
    ours = difference(first, second)
    assert ours.interval == pytest.approx([theirs.low, theirs.high], abs=0.1 * (theirs.high - theirs.low))


def test_the_probability_of_improvement_is_the_share_of_pairs():
    first, second = [[1.0], [3.0], [2.0]], [[2.0], [0.0]]
    # Above 2: the 3, and half of the tie; above 0: all three.
    assert probability_of_improvement(first, second).value == pytest.approx((1.5 + 3) / 6)
    a, b = np.random.default_rng(0).normal(size=(7, 3)), np.random.default_rng(1).normal(size=(9, 3))
    u = stats.mannwhitneyu(a.mean(axis=1), b.mean(axis=1)).statistic
    assert probability_of_improvement(a, b).value == pytest.approx(u / 63)


def test_the_probability_of_improvement_over_itself_is_a_half_and_over_a_worse_one_is_one():
    table = scores(5, 50, between=1.0, own=1.0)
    assert probability_of_improvement(table, table).value == 0.5
    assert probability_of_improvement(table + 100.0, table).interval == [1.0, 1.0]


def test_a_rate_is_all_events_over_all_kilometres():
    crashes = np.zeros((4, 100))
    crashes[:2, :3] = 1
    km = np.full((4, 100), 5.0)
    rate = rate_over_trainings(crashes, km)
    assert rate.value == pytest.approx(6 / 2000)
    assert rate.low == 0.0  # two of the four trainings never crash; a rate is not negative
    assert 3 / 1000 < rate.high < 12 / 1000


def test_no_crash_still_leaves_room_for_some():
    rate = rate_over_trainings(np.zeros((1, 10)), np.full((1, 10), 5.0))
    assert rate.interval == pytest.approx([0.0, poisson_interval(0).high / 50])
    assert rate_over_trainings([[0.0]], [[0.0]]) is None


def test_mcnemar_counts_the_episodes_in_which_the_drivers_differ():
    first = [True, False, False, False, False, False, True, False]
    second = [False, True, True, True, True, True, True, False]
    # Six coin tosses with at most one head, on either side: 2 (1 + 6) / 64.
    found = mcnemar(first, second)
    assert (found.only_first, found.only_second) == (1, 5)
    assert found.p_value == pytest.approx(14 / 64)
    assert mcnemar([True, False], [True, False]).p_value == 1.0


@pytest.mark.parametrize("wrong", [[1.0, 2.0], [[]]])
def test_what_is_no_table_is_refused(wrong):
    with pytest.raises(ValueError, match=r"expected a table of trainings and episodes, \[S, E\]"):
        over_trainings(wrong)


def test_other_episodes_are_refused():
    with pytest.raises(ValueError, match="same episodes"):
        difference(np.zeros((2, 3)), np.zeros((2, 4)))
    with pytest.raises(ValueError, match="one shape"):
        mcnemar([True], [True, False])
