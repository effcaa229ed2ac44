"""What is measured of trajectories worked out by hand.

Distances of histograms with their intervals; what ships.
"""

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from reference.recordings import made_by_hand
from reference.refusals import user_error
from scipy.spatial.distance import jensenshannon
from scipy.stats import binom

from ganlane.data.dense import recordings_of
from ganlane.evaluation.statistics import Estimate
from ganlane.realism.card import verdict
from ganlane.realism.measures import (
    QUANTITIES,
    SHIPPED_REFERENCE,
    Reference,
    ceiling,
    distance,
    distance_difference,
    jensen_shannon,
    measure,
    samples_of,
    with_motion,
)


def values(recording, quantity):
    """The samples of a quantity."""
    motion = with_motion(recording.frame())
    return samples_of(motion)[quantity]["value"].to_numpy()


TIME = np.arange(100)[:, None] * 0.1


def test_constant_acceleration_has_no_jerk_and_a_cubic_path_its_own_and_the_speed_of_the_second():
    result = made_by_hand(10.0 * TIME + 0.5 * 0.8 * TIME**2)
    assert values(result, "acceleration") == pytest.approx(0.8)
    assert values(result, "jerk") == pytest.approx(0.0, abs=1e-9)
    result = made_by_hand(10.0 * TIME + 0.3 * TIME**3 / 6.0)
    assert values(result, "jerk") == pytest.approx(0.3)
    # Mean over the second about t: 10 + 0.3 t^2 / 2 + 0.3 / 24.
    t = TIME[30:95, 0]
    assert values(result, "speed") == pytest.approx(10.0 + 0.15 * t**2 + 0.3 / 24.0)


def test_the_first_three_seconds_of_a_vehicle_do_not_count():
    present = np.ones((100, 2), bool)
    # The second appears after 5 s.
    present[:50, 1] = False
    result = made_by_hand(np.hstack([20.0 * TIME, 20.0 * TIME + 30.0]), present=present)
    # The first: samples 30 to 94. The second appears at 50: samples 80 to 94.
    assert len(values(result, "speed")) == 65 + 15
    assert measure([result]).vehicle_km == pytest.approx((70 + 20) * 2.0 / 1000.0)


CLOSING_IN = np.hstack([12.0 * TIME, 64.0 + 10.0 * TIME])


def test_gap_headway_and_time_to_collision_of_two_cars_whether_or_not_the_leader_is_replayed():
    for driven in (True, False):
        result = made_by_hand(CLOSING_IN, driven=np.array([True, driven]))
        gap = 60.0 - 2.0 * TIME[30:95, 0]
        assert values(result, "gap") == pytest.approx(gap)
        assert values(result, "time_headway") == pytest.approx(gap / 12.0)
        assert values(result, "time_to_collision") == pytest.approx(gap / 2.0)
        assert len(values(result, "speed")) == 65 * (1 + driven)
    # A leader in another lane is none.
    beside = made_by_hand(CLOSING_IN, np.hstack([0.0 * TIME, 0.0 * TIME + 3.5]))
    assert measure([beside]).quantiles["gap"]["0.5"] is None


def test_spread_of_speeds_is_that_within_a_frame():
    # 10, 12 and 14 m/s; two vehicles are too few.
    x = np.hstack([(10.0 + 2.0 * k) * TIME + 40.0 * k for k in range(3)])
    assert values(made_by_hand(x), "speed_spread") == pytest.approx(2.0)
    assert len(values(made_by_hand(x[:, :2]), "speed_spread")) == 0


def test_a_lane_change_counts_once_with_its_duration_unless_it_comes_too_early():
    for start, expected in ((4.0, 1), (0.2, 0)):
        part = np.clip((TIME - start) / 4.0, 0.0, 1.0)
        # Along half a cosine, in 4 s.
        y = 3.5 * 0.5 * (1.0 - np.cos(np.pi * part))
        result = made_by_hand(20.0 * TIME, y)
        assert measure([result]).lane_changes == expected
        assert all(2.0 < duration < 4.0 for duration in values(result, "lane_change_duration"))


def test_histograms_keep_scenes_apart_and_everything_in_the_outermost_bins():
    slow = made_by_hand(10.5 * TIME, name="slow")
    fast = made_by_hand(55.0 * TIME, name="fast")
    counts = measure([slow, fast]).counts["speed"]
    assert counts.shape == (2, QUANTITIES["speed"].bins)
    assert counts[0, 10] == counts[0].sum() == 65
    assert counts[1, -1] == counts[1].sum() == 65


COUNTS = arrays(np.float64, (2, 7), elements=st.integers(0, 50)).filter(
    lambda rows: rows.sum(1).min() > 0
)


@settings(max_examples=30)
@given(COUNTS)
def test_distance_is_that_of_scipy(rows):
    expected = jensenshannon(rows[0], rows[1], base=2)
    assert jensen_shannon(rows[0], rows[1]) == pytest.approx(
        0.0 if math.isnan(expected) else expected, abs=1e-7
    )


def sampled(random, means, sizes):
    """Histograms of binomial numbers up to 20 with these means, one of each size."""
    scenes = [random.binomial(20, mean, size) for mean, size in zip(means, sizes)]
    return np.stack([np.bincount(scene, minlength=21) for scene in scenes]) * 1.0


def histograms(shift, seed, number=12):
    return sampled(np.random.default_rng(seed), [0.3 + shift] * number, [200] * number)


def test_one_scene_gives_no_interval_and_no_verdict():
    assert verdict(Estimate(-0.5, None, None)) == "undecided"
    assert distance(histograms(0.1, 0, 1), histograms(0.0, 1, 1)).interval is None


def intervals_of_40(shift, number):
    """Distances of models that lie by ``shift`` beside the recordings and are driven four times.

    Both are ``number`` histograms with means of their own.
    """
    random = np.random.default_rng(number)
    intervals = []
    for _ in range(40):
        means = random.normal(0.3, 0.05, number).clip(0.1, 0.6)
        size = random.integers(15, 60, number)
        recorded = sampled(random, means, size)
        model = sampled(random, means + shift, 4 * size)
        intervals.append(distance(model, recorded, resamples=300))
    return intervals


@pytest.mark.parametrize("number", [4, 11])
def test_the_interval_of_a_perfect_model_holds_0_and_its_own_estimate(number):
    intervals = intervals_of_40(0.0, number)
    assert sum(interval.low == 0.0 for interval in intervals) >= 0.9 * 40


@pytest.mark.parametrize("number", [4, 11])
def test_the_interval_of_a_model_that_is_off_holds_its_true_distance(number):
    # The distance of the distributions that both are drawn from.
    many = np.random.default_rng(1).normal(0.3, 0.05, 2000).clip(0.1, 0.6)
    chances = [binom.pmf(np.arange(21)[:, None], 20, at).sum(1) for at in (many, many + 0.1)]
    true = float(jensen_shannon(*chances))
    intervals = intervals_of_40(0.1, number)
    assert sum(interval.low <= true <= interval.high for interval in intervals) >= 0.85 * 40
    assert sum(interval.low > 0.0 for interval in intervals) >= 0.9 * 40


def test_a_model_does_not_differ_from_itself_and_unpaired_units_are_resampled_on_its_side():
    model = histograms(0.1, 3)
    assert distance_difference(model, model, histograms(0.0, 5), resamples=50) == Estimate(
        0.0, 0.0, 0.0
    )
    model = histograms(0.1, 3, 5)
    recorded = histograms(0.0, 5, 8)
    estimate = distance(model, recorded, paired=False, resamples=100)
    assert estimate.low <= estimate.value <= estimate.high
    assert distance(model[:1], recorded, paired=False).interval is None


def without_checksum(path):
    numbers = json.loads(path.read_text())
    del numbers["checksum"]
    return numbers


def test_what_ships_is_written_again_as_it_is(tmp_path):
    path = tmp_path / "reference.json"
    Reference.load(SHIPPED_REFERENCE).save(path)
    assert without_checksum(path) == without_checksum(SHIPPED_REFERENCE)


@pytest.mark.parametrize("wrong", [None, {"kind": "a recipe"}, {"bins": {}}])
def test_another_file_is_refused_in_a_sentence(wrong, tmp_path):
    path = tmp_path / "reference.json"
    if wrong is not None:
        path.write_text(json.dumps(without_checksum(SHIPPED_REFERENCE) | wrong))
    with user_error(r"reference\.json: not the histograms"):
        Reference.load(path)


def test_what_ships_is_small_and_holds_no_trajectories():
    shipped = Reference.load(SHIPPED_REFERENCE)
    assert SHIPPED_REFERENCE.stat().st_size < 200_000
    assert len(shipped.units) == 11
    # Published with the recordings.
    assert shipped.whole["lane_changes"] == 57
    assert shipped.whole["vehicle_km"] == pytest.approx(61.7, abs=0.1)
    assert shipped.whole["speed_spread_mps"] == pytest.approx(2.8, abs=0.05)
    for name in ("acceleration", "jerk", "time_headway", "time_to_collision"):
        assert ceiling(shipped.counts[name]) < shipped.floors["random"][name]
    assert all(0.0 < ceiling(shipped.counts[name]) < 1.0 for name in QUANTITIES)


def test_what_ships_is_what_the_recordings_show(us101_scenes):
    recordings = recordings_of(us101_scenes)
    measured = measure(recordings)
    shipped = Reference.load(SHIPPED_REFERENCE)
    assert shipped.units == [recording.name for recording in recordings]
    for name in QUANTITIES:
        assert np.array_equal(measured.counts[name], shipped.counts[name])
