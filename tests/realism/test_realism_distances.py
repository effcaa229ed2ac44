"""Distances between histograms, their scale, and their intervals."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.distance import jensenshannon
from scipy.stats import binom

from ganlane.evaluation.statistics import Estimate
from ganlane.realism.card import verdict
from ganlane.realism.distances import ceiling, distance, distance_difference, jensen_shannon

COUNTS = arrays(np.float64, (2, 7), elements=st.integers(0, 50)).filter(lambda rows: rows.sum(1).min() > 0)


@given(COUNTS)
def test_distance_is_that_of_scipy(rows):
    expected = jensenshannon(rows[0], rows[1], base=2)
    assert jensen_shannon(rows[0], rows[1]) == pytest.approx(0.0 if math.isnan(expected) else expected, abs=1e-7)


def test_equal_shapes_are_at_0_and_disjoint_ones_at_1():
    assert jensen_shannon(np.array([1.0, 3.0]), np.array([10.0, 30.0])) == pytest.approx(0.0, abs=1e-7)
    assert jensen_shannon(np.array([5.0, 0.0]), np.array([0.0, 2.0])) == pytest.approx(1.0)
    assert np.isnan(jensen_shannon(np.zeros(2), np.ones(2)))


def test_scenes_that_are_alike_have_a_low_ceiling_and_unlike_ones_a_high_one():
    alike = np.tile([4.0, 8.0, 4.0], (6, 1))
    unlike = np.eye(6) * 10.0
    assert ceiling(alike) == pytest.approx(0.0, abs=1e-7)
    assert ceiling(unlike) == pytest.approx(1.0)
    assert ceiling(alike[:1]) is None


def scenes(shift, seed, number=12):
    random = np.random.default_rng(seed)
    return np.stack([np.bincount(random.binomial(20, 0.3 + shift, 200), minlength=21) for _ in range(number)]) * 1.0


def test_a_model_that_is_nearer_in_every_scene_is_found_to_be_closer():
    recorded, near, far = scenes(0.0, 0), scenes(0.02, 1), scenes(0.2, 2)
    difference = distance_difference(near, far, recorded, resamples=400)
    assert difference.high < 0.0
    assert difference.value == pytest.approx(distance(near, recorded).value - distance(far, recorded).value)
    assert verdict(difference) == "closer"
    assert verdict(distance_difference(far, near, recorded, resamples=400)) == "farther"


def test_two_runs_of_one_model_are_undecided():
    difference = distance_difference(scenes(0.1, 3), scenes(0.1, 4), scenes(0.0, 5), resamples=400)
    assert difference.low < 0.0 < difference.high
    assert verdict(difference) == "undecided"


def test_one_scene_gives_no_interval_and_no_verdict():
    one = distance(scenes(0.1, 0, 1), scenes(0.0, 1, 1))
    assert one.interval is None
    assert verdict(Estimate(-0.5, None, None)) == "undecided"


def draws(shift, number, trials=40):
    """Recordings and a model that lies by ``shift`` beside them, of scenes with means of their own."""
    random = np.random.default_rng(number)
    for _ in range(trials):
        means = random.normal(0.3, 0.05, number).clip(0.1, 0.6)
        size = random.integers(15, 60, number)
        yield [
            np.stack([np.bincount(random.binomial(20, p, times * n), minlength=21) for p, n in zip(at, size)]) * 1.0
            for at, times in ((means, 1), (means + shift, 4), (means + shift, 4))
        ]


@pytest.mark.parametrize("number", [4, 11])
def test_the_interval_of_a_perfect_model_holds_0_and_its_own_estimate(number):
    intervals = [distance(model, recorded, resamples=300) for recorded, model, _ in draws(0.0, number)]
    assert all(each.low <= each.value <= each.high for each in intervals)
    assert sum(each.low == 0.0 for each in intervals) >= 0.9 * len(intervals)


@pytest.mark.parametrize("number", [4, 11])
def test_the_interval_of_a_model_that_is_off_holds_its_true_distance(number):
    many = np.random.default_rng(1).normal(0.3, 0.05, 2000).clip(0.1, 0.6)
    true = float(jensen_shannon(*(binom.pmf(np.arange(21)[:, None], 20, at).sum(1) for at in (many, many + 0.1))))
    intervals = [distance(model, recorded, resamples=300) for recorded, model, _ in draws(0.1, number)]
    assert sum(each.low <= true <= each.high for each in intervals) >= 0.85 * len(intervals)
    assert sum(each.low > 0.0 for each in intervals) >= 0.9 * len(intervals)


@pytest.mark.parametrize(("number", "shift"), [(4, 0.0), (11, 0.0), (4, 0.1), (11, 0.1)])
def test_two_equally_good_models_are_seldom_told_apart(number, shift):
    verdicts = [
        verdict(distance_difference(*models, recorded, resamples=300)) for recorded, *models in draws(shift, number)
    ]
    assert verdicts.count("undecided") >= 0.9 * len(verdicts)


@given(COUNTS, COUNTS, COUNTS)
def test_every_interval_holds_its_estimate(recorded, first, second):
    for estimate in (
        distance(first, recorded, resamples=20),
        distance_difference(first, second, recorded, resamples=20),
    ):
        assert estimate.low <= estimate.value <= estimate.high
    assert distance(first, recorded, resamples=20).low >= 0.0


def test_a_model_does_not_differ_from_itself():
    model = scenes(0.1, 3)
    assert distance_difference(model, model, scenes(0.0, 5), resamples=50) == Estimate(0.0, 0.0, 0.0)


def test_unpaired_units_are_resampled_on_the_side_of_the_model():
    model, recorded = scenes(0.1, 3, 5), scenes(0.0, 5, 8)
    estimate = distance(model, recorded, paired=False, resamples=100)
    assert estimate.low <= estimate.value <= estimate.high
    assert distance(model[:1], recorded, paired=False).interval is None
