"""Distances between histograms, their scale, and their intervals."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.distance import jensenshannon

from ganlane.evaluation.realism.card import verdict
from ganlane.evaluation.realism.distances import ceiling, distance, distance_difference, jensen_shannon
from ganlane.evaluation.statistics import Estimate

COUNTS = arrays(np.float64, (2, 7), elements=st.integers(0, 50)).filter(lambda rows: rows.sum(1).min() > 0)


@given(COUNTS)
def test_distance_is_that_of_scipy(rows):
    expected = jensenshannon(rows[0], rows[1], base=2)
    assert jensen_shannon(rows[0], rows[1]) == pytest.approx(0.0 if math.isnan(expected) else expected, abs=1e-7)


@given(COUNTS)
def test_distance_is_symmetric_and_between_0_and_1(rows):
    there, back = jensen_shannon(rows[0], rows[1]), jensen_shannon(rows[1], rows[0])
    assert there == pytest.approx(float(back), abs=1e-12)
    assert 0.0 <= there <= 1.0


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


def test_interval_holds_the_distance_of_scenes_that_differ():
    estimate = distance(scenes(0.15, 6), scenes(0.0, 7), resamples=400)
    assert estimate.low < estimate.value < estimate.high
