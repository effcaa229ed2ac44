"""Recorded scenes as arrays, segments and windows cut from them, and k-means groups of windows."""

import numpy as np
import polars as pl
import pytest
import torch
from reference.refusals import user_error
from reference.synthetic import synthetic_scenes

from ganlane.data.dense import recordings_of
from ganlane.generator.windows import (
    PRESENT,
    WINDOW_FRAMES,
    count_windows,
    cut_windows,
    group_windows,
    kmeans_labels,
)


def recording():
    """Three scenes of vehicles that come and go, some with a gap in their track."""
    frame = synthetic_scenes(scenes=3, vehicles=14, seconds=4.0)
    vehicle, number = pl.col("vehicle"), pl.col("frame")
    there = number.is_between(vehicle % 12, 40 - vehicle) & (number != 4 * vehicle)
    # Numbers that are no indices.
    return frame.filter(there).with_columns(vehicle + 999, number + 100)


@pytest.fixture(scope="module")
def windows():
    return cut_windows(recordings_of(recording()))


def test_a_changer_intends_its_new_lane_two_seconds_before_it_is_there(scenes):
    tracks = zip(scenes[0].lane.T, scenes[0].target_lane.T)
    lane, target = next((lane, target) for lane, target in tracks if len(set(lane)) == 2)
    crossed = int((lane != lane[0]).argmax())
    first = int((target != lane[0]).argmax())
    assert first == max(0, crossed - 20)


def brute_force_windows(frame, stride):
    """(scene, start row, vehicle number) -> positions, by looking every frame up in a
    dictionary.
    """
    windows = {}
    for (scene,), cars in frame.group_by("scene"):
        rows = cars.select("vehicle", "frame", "x", "y").iter_rows()
        places = {(vehicle, number): place for vehicle, number, *place in rows}
        begin = cars["frame"].min()
        for vehicle, first in places:
            course = [places.get((vehicle, first + step)) for step in range(WINDOW_FRAMES)]
            if None not in course and (first - begin) % stride == 0:
                windows[scene, first - begin, vehicle] = course
    return windows


@pytest.mark.parametrize("stride", [1, 3])
def test_windows_are_those_of_a_brute_force_search(stride):
    frame = recording()
    scenes = recordings_of(frame)
    windows = cut_windows(scenes, stride)
    expected = brute_force_windows(frame, stride)
    # Columns of a scene are its vehicles in the order of their numbers, which begin at 1000.
    keys = list(zip(windows.scene, windows.start, 1000 + windows.vehicle))
    assert sorted(keys) == sorted(expected)
    np.testing.assert_array_equal(windows.positions, [expected[key] for key in keys])
    if stride == 1:
        assert [count_windows(scene) for scene in scenes] == [
            len(cut_windows([scene])) for scene in scenes
        ]


def test_recordings_without_a_needed_column_or_too_short_are_refused():
    with user_error("lane"):
        recordings_of(recording().drop("lane"))
    with user_error("without rows"):
        recordings_of(recording().clear())
    with user_error("17 frames"):
        cut_windows(recordings_of(recording().filter(pl.col("frame") < 110)))


def test_groups_never_mix_scenes_or_frames_lose_nobody_and_hold_the_displacements_of_their_windows(
    windows,
):
    groups = group_windows(windows, size=4)
    assert (groups.window == group_windows(windows, size=4).window).all()
    assert sorted(groups.window[groups.mask].tolist()) == list(range(len(windows)))
    for row, mask in enumerate(groups.mask):
        inside = groups.window[row][mask].numpy()
        assert len(set(zip(windows.scene[inside], windows.start[inside]))) == 1
        moves = groups.displacements[row][mask].numpy()
        place = windows.positions[inside, PRESENT]
        np.testing.assert_allclose(moves, np.diff(windows.positions[inside], axis=1), atol=1e-6)
        np.testing.assert_allclose(
            groups.position[row][mask].numpy(), place - place.mean(0), atol=1e-4
        )


def test_kmeans_puts_two_distant_platoons_into_two_groups():
    platoon = np.array([[5.0 * k, 0.0] for k in range(9)])
    labels = kmeans_labels(np.concatenate([platoon, platoon + 400.0]), size=9, seed=0)
    assert len(set(labels[:9])) == len(set(labels[9:])) == 1
    assert labels[0] != labels[9]


def test_mirroring_flips_only_the_chosen_groups(windows):
    groups = group_windows(windows, size=4).select(slice(0, 2))
    flipped = groups.mirrored(torch.tensor([False, True]))
    for name in ("displacements", "position"):
        now, before = getattr(flipped, name), getattr(groups, name)
        assert (now[0] == before[0]).all()
        assert (now[1] == before[1] * torch.tensor([1.0, -1.0])).all()
