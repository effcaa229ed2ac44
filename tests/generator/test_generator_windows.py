"""Windows cut from recorded scenes, their k-means groups, and the groups' cache."""

from unittest.mock import Mock

import numpy as np
import polars as pl
import pytest
import torch

from ganlane.data import SCHEMA
from ganlane.errors import UserError
from ganlane.generator.segments import OBSERVED_POSITIONS, scene_tracks
from ganlane.generator.windows import (
    CACHE_VARIABLE,
    WINDOW_FRAMES,
    cache_folder,
    cached,
    content_hash,
    count_windows,
    cut_windows,
    group_windows,
    kmeans_labels,
)


def recording(seed: int = 0, scenes: int = 3, vehicles: int = 14) -> pl.DataFrame:
    """Vehicles that come and go at random, some with a gap in their track."""
    random = np.random.default_rng(seed)
    rows = []
    for scene in range(scenes):
        for vehicle in range(vehicles):
            first, last = random.integers(0, 12), random.integers(20, 40)
            gap, lane = random.integers(0, 60), vehicle % 3
            x, y = random.uniform(0, 200), 3.5 * lane
            for frame in range(100 + first, 100 + last):
                if frame != 100 + gap:
                    x, y = x + random.uniform(0.5, 2.0), y + random.normal(0, 0.05)
                    rows.append((f"scene-{scene}", 1000 + vehicle, frame, x, y, 12.0, lane, 4.5 + vehicle % 3, 2.0))
    return pl.DataFrame(rows, schema=SCHEMA, orient="row")


def brute_force_windows(frame: pl.DataFrame, stride: int) -> dict[tuple[str, int, int], np.ndarray]:
    """(scene, start row, vehicle number) -> positions, by looking every position up in a dictionary."""
    place = {(s, v, f): (x, y) for s, v, f, x, y in frame.select("scene", "vehicle", "frame", "x", "y").iter_rows()}
    begins = {s: f for s, f in frame.group_by("scene").agg(pl.col("frame").min()).iter_rows()}
    found = {}
    for (scene, vehicle, first), _ in place.items():
        course = [place.get((scene, vehicle, first + step)) for step in range(WINDOW_FRAMES)]
        row = first - begins[scene]
        if None not in course and row % stride == 0:
            found[scene, row, vehicle] = np.array(course)
    return found


@pytest.mark.parametrize("stride", [1, 3])
def test_windows_are_those_of_a_brute_force_search(stride):
    frame = recording()
    scenes = scene_tracks(frame)
    windows = cut_windows(scenes, stride)
    expected = brute_force_windows(frame, stride)
    numbers = [scenes[s].vehicles[v] for s, v in zip(windows.scene, windows.vehicle)]
    keys = [(windows.scene_names[s], t, v) for s, t, v in zip(windows.scene, windows.start, numbers)]
    assert set(keys) == set(expected)
    assert len(keys) == len(expected)
    np.testing.assert_array_equal(windows.positions, np.stack([expected[key] for key in keys]))


def test_a_window_carries_the_lane_and_length_of_its_vehicle():
    frame = recording()
    scenes = scene_tracks(frame)
    windows = cut_windows(scenes)
    row = len(windows.scene) // 2
    scene = scenes[windows.scene[row]]
    number, now = (
        scene.vehicles[windows.vehicle[row]],
        scene.first_frame + windows.start[row] + OBSERVED_POSITIONS - 1,
    )
    same = (pl.col("scene") == scene.name) & (pl.col("vehicle") == number) & (pl.col("frame") == now)
    record = frame.filter(same).row(0, named=True)
    assert (windows.lane[row], windows.length[row]) == (record["lane"], record["length"])


def test_recordings_without_a_needed_column_or_too_short_are_refused():
    with pytest.raises(UserError, match="lane"):
        scene_tracks(recording().drop("lane"))
    with pytest.raises(UserError, match="no rows"):
        scene_tracks(recording().clear())
    with pytest.raises(UserError, match="17 frames"):
        cut_windows(scene_tracks(recording().filter(pl.col("frame") < 110)))


def test_windows_are_counted_as_they_are_cut():
    scenes = scene_tracks(recording())
    assert [count_windows(scene) for scene in scenes] == [len(cut_windows([scene])) for scene in scenes]


ARRAYS = {"labels": np.arange(5), "more": np.ones((2, 3))}


def test_a_cached_result_is_computed_again_only_where_its_file_is_damaged(monkeypatch, tmp_path):
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    compute = Mock(return_value=ARRAYS)
    first, again = (cached("groups", "key", compute) for _ in range(2))
    assert compute.call_count == 1
    assert first.keys() == again.keys()
    assert all((first[name] == again[name]).all() for name in first)
    (file,) = tmp_path.iterdir()
    for damage in (b"", b"PK\x03\x04 half a file", b"something else"):
        file.write_bytes(damage)
        assert (cached("groups", "key", compute)["labels"] == np.arange(5)).all()
    assert compute.call_count == 4
    cached("groups", "another", compute)
    assert compute.call_count == 5


def test_an_unwritable_cache_folder_is_ignored(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "file"))
    assert (cached("groups", "key", lambda: ARRAYS)["labels"] == np.arange(5)).all()


def test_an_empty_name_switches_the_cache_off_and_none_takes_the_users_folder(monkeypatch, tmp_path):
    monkeypatch.setenv(CACHE_VARIABLE, "")
    assert cache_folder() is None
    monkeypatch.delenv(CACHE_VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "ganlane"


def test_the_hash_sees_settings_values_shapes_and_types():
    values = np.arange(6.0)
    hashes = {
        content_hash({"size": 9}, values),
        content_hash({"size": 8}, values),
        content_hash({"size": 9}, values + 1e-9),
        content_hash({"size": 9}, values.reshape(2, 3)),
        content_hash({"size": 9}, values.astype(np.float32)),
        content_hash({"size": 9}, values, values),
    }
    assert len(hashes) == 6
    assert content_hash({"a": 1, "b": 2}, values) == content_hash({"b": 2, "a": 1}, values.copy())


def test_groups_never_mix_scenes_or_frames_and_lose_nobody():
    windows = cut_windows(scene_tracks(recording()))
    groups = group_windows(windows, size=4)
    assert (groups.window == group_windows(windows, size=4).window).all()
    members = groups.window[groups.mask].numpy()
    assert sorted(members) == list(range(len(windows.scene)))
    for row in range(len(groups)):
        inside = groups.window[row][groups.mask[row]].numpy()
        assert len(set(zip(windows.scene[inside], windows.start[inside]))) == 1


def test_groups_hold_the_displacements_of_their_windows():
    windows = cut_windows(scene_tracks(recording()))
    groups = group_windows(windows, size=4)
    inside = groups.window[5][groups.mask[5]].numpy()
    kept = groups.displacements[5][groups.mask[5]].numpy()
    np.testing.assert_allclose(kept, np.diff(windows.positions[inside], axis=1), atol=1e-6)
    place = windows.positions[inside, OBSERVED_POSITIONS - 1]
    np.testing.assert_allclose(groups.position[5][groups.mask[5]].numpy(), place - place.mean(0), atol=1e-4)


def test_kmeans_puts_two_distant_platoons_into_two_groups():
    platoon = np.array([[5.0 * k, 0.0] for k in range(9)])
    labels = kmeans_labels(np.concatenate([platoon, platoon + 400.0]), size=9, seed=0)
    assert len(set(labels[:9])) == len(set(labels[9:])) == 1
    assert labels[0] != labels[9]


def test_mirroring_flips_only_the_chosen_groups():
    groups = group_windows(cut_windows(scene_tracks(recording())), size=4).select(slice(0, 2))
    flipped = groups.mirrored(torch.tensor([False, False]))
    assert (flipped.displacements == groups.displacements).all()
    flipped = groups.mirrored(torch.tensor([True, True]))
    assert (flipped.displacements[..., 1] == -groups.displacements[..., 1]).all()
    assert (flipped.displacements[..., 0] == groups.displacements[..., 0]).all()
    assert (flipped.position[..., 1] == -groups.position[..., 1]).all()
