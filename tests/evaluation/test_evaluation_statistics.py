"""Intervals against closed forms, SciPy, tables and hand-worked values."""

import numpy as np
import pytest
from scipy import stats

from ganlane.evaluation.statistics import (
    Estimate,
    clopper_pearson,
    difference,
    entries,
    improvement_over_traffics,
    interquartile_mean,
    mcnemar,
    mean_interval,
    over_trainings,
    poisson_interval,
    rate_over_trainings,
    sign_flip_p,
)


def test_the_interval_is_scipys_bca_and_repeats_with_its_seed():
    generator = np.random.default_rng(3)
    # Returns as they look here: most near 260, a few crashes far below.
    skewed = np.where(generator.random(200) < 0.08, -20.0, 260.0) + generator.normal(0, 20, 200)
    ours = mean_interval(skewed)
    theirs = stats.bootstrap(
        (skewed,), np.mean, n_resamples=10_000, method="BCa", random_state=5
    ).confidence_interval
    width = theirs.high - theirs.low
    assert ours.value == pytest.approx(skewed.mean())
    assert ours.interval == pytest.approx([theirs.low, theirs.high], abs=0.04 * width)
    assert mean_interval(skewed) == ours


def test_one_value_has_no_interval_and_equal_values_have_an_empty_one():
    assert mean_interval([3.0]).interval is None
    assert mean_interval([3.0, 3.0, 3.0]).interval == [3.0, 3.0]
    assert not mean_interval([3.0]).excludes_zero()


def test_an_estimate_is_scaled_with_its_bounds_and_gives_a_rows_entries():
    rate = poisson_interval(5).scaled(1000.0, per=2500.0)
    assert rate.value == pytest.approx(2.0)
    assert rate.interval == pytest.approx([1.623 / 2.5, 11.668 / 2.5], abs=1e-3)
    assert Estimate(4.0).scaled(0.5) == Estimate(2.0)
    assert entries("rate", Estimate(2.0, 1.0, 3.0)) == {"rate": 2.0, "rate_ci": [1.0, 3.0]}
    nothing = {"rate": None, "rate_ci": None}
    assert entries("rate", None) == entries("rate", Estimate(float("nan"))) == nothing


@pytest.mark.parametrize(("count", "trials"), [(0, 50), (3, 20), (50, 50), (700, 2000)])
def test_the_binomial_interval_agrees_with_scipy(count, trials):
    theirs = stats.binomtest(count, trials).proportion_ci(0.95, "exact")
    assert clopper_pearson(count, trials).interval == pytest.approx([theirs.low, theirs.high])


# Several trainings of one recipe


def scores(trainings, episodes, between=0.0, shared=0.0, rest=0.0, seed=0):
    """Scores [S, E] that vary between trainings, between episodes (shared), and otherwise."""
    generator = np.random.default_rng(seed)
    of_training = between * generator.normal(size=(trainings, 1))
    of_episode = shared * generator.normal(size=(1, episodes))
    return of_training + of_episode + rest * generator.normal(size=(trainings, episodes))


def width(estimate):
    return estimate.high - estimate.low


def test_the_interquartile_mean_is_that_of_the_middle_half():
    assert interquartile_mean([100.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, -50.0]) == 4.5
    assert interquartile_mean([9.0, 1.0, 2.0, 3.0, 100.0]) == pytest.approx((2 + 3 + 9) / 3)
    assert interquartile_mean([[1.0, 3.0], [5.0, 7.0]]) == pytest.approx([2.0, 6.0])


@pytest.mark.parametrize(
    "table", [scores(1, 400, rest=10.0), scores(200, 1, between=3.0)], ids=["one", "many"]
)
def test_one_training_has_the_interval_of_its_episodes_and_one_episode_that_of_its_trainings(table):
    estimate = over_trainings(table)
    assert estimate.value == pytest.approx(table.mean())
    assert width(estimate) == pytest.approx(2 * 1.96 * table.std() / np.sqrt(table.size), rel=0.08)


@pytest.mark.parametrize(("trainings", "between"), [(3, 0.0), (3, 20.0), (5, 2.0)])
def test_an_interval_holds_the_truth_in_95_of_100_recipes(trainings, between):
    tables = [
        scores(trainings, 100, between=between, shared=10.0, rest=10.0, seed=seed)
        for seed in range(200)
    ]
    held = [estimate.low <= 0.0 <= estimate.high for estimate in map(over_trainings, tables)]
    # The plain bootstrap of three holds it in three quarters of them where trainings differ by 20.
    assert 0.91 <= np.mean(held) <= 0.99


def probability_of_improvement(first, second):
    return improvement_over_traffics([(first, second)])


def test_the_probability_of_improvement_is_the_share_of_pairs():
    table = scores(5, 50, between=1.0, rest=1.0)
    assert probability_of_improvement(table, table).value == 0.5
    assert probability_of_improvement(table + 100.0, table).interval == [1.0, 1.0]
    # Some means are equal.
    first, second = np.arange(14).reshape(7, 2) % 4, np.arange(18).reshape(9, 2) % 5
    u = stats.mannwhitneyu(first.mean(axis=1), second.mean(axis=1)).statistic
    assert probability_of_improvement(first, second).value == pytest.approx(u / 63)


def test_the_sign_flip_test_counts_how_many_signs_are_as_far_from_zero():
    differences = [4.0, -1.0, 2.5, 3.0, 0.5, 6.0, -2.0, 1.0]
    theirs = stats.permutation_test((differences,), np.sum, permutation_type="samples")
    assert sign_flip_p(differences) == pytest.approx(theirs.pvalue, abs=0.015)
    assert sign_flip_p([0.0, 0.0]) == 1.0


def test_a_rate_over_trainings_is_never_surer_than_its_count():
    generator = np.random.default_rng(4)
    for trainings in (1, 2, 3, 5):
        crashes = (generator.random((trainings, 200)) < 0.02).astype(float)
        km = np.full(crashes.shape, 5.0)
        rate = rate_over_trainings(crashes, km)
        exact = poisson_interval(int(crashes.sum())).scaled(per=float(km.sum()))
        assert rate.low <= exact.low < exact.high <= rate.high


@pytest.mark.slow
@pytest.mark.parametrize("spread", [0.0, 0.25, 0.5, 0.8])
@pytest.mark.parametrize("crashes", [1, 3, 10, 30])
@pytest.mark.parametrize("trainings", [3, 5])
def test_a_rate_s_interval_holds_the_truth_where_trainings_differ(trainings, crashes, spread):
    generator = np.random.default_rng(1)
    held = 0
    for _ in range(1000):
        rates = np.full(trainings, float(crashes))
        if spread > 0.0:
            rates = generator.gamma(spread**-2, crashes * spread**2, trainings)
        events = generator.poisson(rates[:, None] / 100, (trainings, 100))
        estimate = rate_over_trainings(events, np.ones(events.shape))
        held += estimate.low <= crashes / 100 <= estimate.high
    # The resampled trainings alone hold it in 85 to 90 of 100 where rates differ by 0.8.
    assert held >= 0.93 * 1000


def test_a_rate_is_all_events_over_all_kilometres_and_no_crash_leaves_room_for_some():
    crashes = np.zeros((4, 100))
    crashes[:2, :3] = 1
    rate = rate_over_trainings(crashes, np.full((4, 100), 5.0))
    assert rate.value == pytest.approx(6 / 2000)
    assert rate.low == 0.0  # two of the four trainings never crash; a rate is not negative
    # Trainings that differ so much leave room for several times the rate.
    assert 12 / 1000 < rate.high < 20 / 1000
    rate = rate_over_trainings(np.zeros((1, 10)), np.full((1, 10), 5.0))
    assert rate.interval == pytest.approx([0.0, poisson_interval(0).high / 50])
    assert rate_over_trainings([[0.0]], [[0.0]]) is None
    # Of two trainings one left the road at once: a draw of that one alone tells no rate.
    rate = rate_over_trainings([[1.0, 0.0], [0.0, 0.0]], [[4.0, 6.0], [0.0, 0.0]])
    assert rate.value == pytest.approx(0.1)
    assert np.isfinite(rate.interval).all()


def test_mcnemar_counts_the_episodes_in_which_the_drivers_differ():
    first = [True, False, False, False, False, False, True, False]
    second = [False, True, True, True, True, True, True, False]
    # Six coin tosses with at most one head, on either side: 2 (1 + 6) / 64.
    test = mcnemar(first, second)
    assert (test.only_first, test.only_second) == (1, 5)
    assert test.p_value == pytest.approx(14 / 64)
    assert mcnemar([True, False], [True, False]).p_value == 1.0


@pytest.mark.parametrize(
    ("call", "arguments", "told"),
    [
        (over_trainings, [[1.0, 2.0]], r"expected a table of trainings and episodes, \[S, E\]"),
        (over_trainings, [[[]]], r"expected a table of trainings and episodes, \[S, E\]"),
        (difference, [np.zeros((2, 3)), np.zeros((2, 4))], "same episodes"),
        (mcnemar, [[True], [True, False]], "one shape"),
    ],
)
def test_what_is_no_table_and_other_episodes_are_refused(call, arguments, told):
    with pytest.raises(ValueError, match=told):
        call(*arguments)
