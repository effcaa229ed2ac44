"""Crashes per km by scene: the ratio of sums, and an interval that comes from scenes and not from episodes."""

from __future__ import annotations

from itertools import product

import numpy as np
import polars as pl
import pytest

from ganlane.errors import UserError
from ganlane.evaluation.by_scene import crashes_by_scene


def table(*rows: tuple[str, int, int, float]) -> tuple[pl.DataFrame, list[str]]:
    """(scene, episodes, crashes, m per episode) as episodes and their scenes."""
    reasons, distances, scenes = [], [], []
    for scene, episodes, crashes, metres in rows:
        reasons += ["hard_crash"] * crashes + ["scene_end"] * (episodes - crashes)
        distances += [metres] * episodes
        scenes += [scene] * episodes
    return pl.DataFrame({"reason": reasons, "distance_m": distances}), scenes


def test_the_rate_is_all_crashes_over_all_kilometres():
    found = crashes_by_scene(*table(("b", 10, 1, 100.0), ("a", 5, 3, 400.0)))
    assert found.per_km.value == pytest.approx(4 / 3.0)
    assert [(row["scene"], row["episodes"], row["hard_crash"]) for row in found.rows] == [("a", 5, 3), ("b", 10, 1)]
    assert [row["distance_km"] for row in found.rows] == pytest.approx([2.0, 1.0])
    assert [row["crashes_per_km"] for row in found.rows] == pytest.approx([1.5, 1.0])
    # Garwood's exact bounds for one event: 0.0253 and 5.572.
    assert found.rows[1]["crashes_per_km_ci"] == pytest.approx([0.0253, 5.572], abs=1e-3)


def test_the_interval_is_that_of_all_resamples_of_the_scenes():
    scenes = [("a", 10, 2, 100.0), ("b", 10, 0, 300.0), ("c", 10, 5, 200.0)]
    crashes, km = np.array([2.0, 0.0, 5.0]), np.array([1.0, 3.0, 2.0])
    # All 27 resamples of three scenes are equally likely.
    ratios = [crashes[list(drawn)].sum() / km[list(drawn)].sum() for drawn in product(range(3), repeat=3)]
    low, high = np.quantile(np.repeat(ratios, 1000), [0.025, 0.975])
    found = crashes_by_scene(*table(*scenes)).per_km
    assert (found.low, found.high) == pytest.approx((low, high))
    assert (low, high) == pytest.approx((0.0, 2.5))


def test_more_episodes_of_the_same_scenes_do_not_narrow_the_interval():
    few = crashes_by_scene(*table(("a", 10, 2, 100.0), ("b", 10, 1, 300.0), ("c", 10, 5, 200.0))).per_km
    many = crashes_by_scene(*table(("a", 100, 20, 100.0), ("b", 100, 10, 300.0), ("c", 100, 50, 200.0))).per_km
    assert (few.low, few.high) == pytest.approx((many.low, many.high))


def test_no_crash_is_not_certainty():
    found = crashes_by_scene(*table(("a", 10, 0, 100.0), ("b", 10, 0, 100.0))).per_km
    assert (found.value, found.low) == (0.0, 0.0)
    assert found.high == pytest.approx(3.689 / 2.0, abs=1e-3)


def test_one_scene_has_no_interval_and_one_without_distance_no_rate():
    assert crashes_by_scene(*table(("a", 10, 1, 100.0))).per_km.interval is None
    found = crashes_by_scene(*table(("a", 10, 1, 100.0), ("b", 1, 0, 0.0)))
    assert found.rows[1]["crashes_per_km"] is None
    assert np.isfinite([found.per_km.low, found.per_km.high]).all()


def test_what_does_not_fit_together_is_refused():
    episodes, scenes = table(("a", 3, 1, 100.0))
    with pytest.raises(UserError, match="2 scenes for 3 episodes"):
        crashes_by_scene(episodes, scenes[:2])
    with pytest.raises(UserError, match="nobody drove"):
        crashes_by_scene(*table(("a", 3, 0, 0.0)))
