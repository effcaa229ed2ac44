"""Synthetic recordings: the same for a seed, and nobody overlaps."""

import polars as pl
import pytest

from ganlane.data import (
    SyntheticTraffic,
    find_lane_changes,
    leader_gaps,
    scene_lane_counts,
    synthetic_scenes,
    tracks_of_frame,
    validate,
)


def test_a_seed_makes_one_recording_and_another_seed_another():
    assert synthetic_scenes(seed=1).equals(synthetic_scenes(seed=1))
    assert not synthetic_scenes(seed=1).equals(synthetic_scenes(seed=2))
    one, other = synthetic_scenes(seed=1).partition_by("scene", include_key=False)
    assert not one.equals(other)


@pytest.mark.parametrize("lanes", [1, 2, 5])
def test_it_fits_the_schema_and_uses_every_lane(lanes):
    made = synthetic_scenes(SyntheticTraffic(lanes=lanes))
    assert validate(made, "made").equals(made)
    assert set(scene_lane_counts(made).values()) == {lanes}


@pytest.mark.parametrize("seed", range(5))
def test_nobody_comes_near_another_along_the_road(seed):
    # All put into one lane, the smallest gap is still that between slots less the sway of both.
    one_lane = synthetic_scenes(seed=seed).with_columns(lane=pl.lit(0, pl.Int64))
    assert leader_gaps(one_lane)["gap"].min() > 2.0


def test_the_share_of_changing_vehicles_is_found_by_the_detector():
    widths = {"synthetic-0": 3.5}
    all_change = SyntheticTraffic(scenes=1, vehicles=40, changing_share=1.0, wander_m=0.0)
    assert len(find_lane_changes(tracks_of_frame(synthetic_scenes(all_change), widths))) == 40
    none_change = SyntheticTraffic(scenes=1, vehicles=40, changing_share=0.0)
    assert len(find_lane_changes(tracks_of_frame(synthetic_scenes(none_change), widths))) == 0
