import numpy as np
import polars as pl
import pytest

from ganlane.data.schema import SCHEMA
from ganlane.errors import UserError
from ganlane.generator.splits import split_scenes
from ganlane.generator.windows import OBSERVED_POSITIONS, WINDOW_FRAMES, cut_windows, scene_tracks


def recording(seed: int = 0, scenes: int = 3, vehicles: int = 14) -> pl.DataFrame:
    """Vehicles that come and go at random, some with a gap in their track."""
    random = np.random.default_rng(seed)
    rows = []
    for scene in range(scenes):
        for vehicle in range(vehicles):
            first, last = random.integers(0, 12), random.integers(20, 40)
            gap = random.integers(0, 60)
            x, y, lane = random.uniform(0, 200), random.uniform(0, 8), int(random.integers(0, 3))
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


def test_split_keeps_every_scene_on_one_side():
    fitted, held_out = split_scenes(scene_tracks(recording()), ("scene-1",))
    assert [scene.name for scene in fitted] == ["scene-0", "scene-2"]
    assert [scene.name for scene in held_out] == ["scene-1"]


@pytest.mark.parametrize("held_out", [("nowhere",), (), ("scene-0", "scene-1", "scene-2")])
def test_a_split_without_two_parts_is_refused(held_out):
    with pytest.raises(UserError, match=r"data\.held_out="):
        split_scenes(scene_tracks(recording()), held_out)


def test_recordings_without_a_needed_column_or_too_short_are_refused():
    with pytest.raises(UserError, match="lane"):
        scene_tracks(recording().drop("lane"))
    with pytest.raises(UserError, match="no rows"):
        scene_tracks(recording().clear())
    with pytest.raises(UserError, match="17 frames"):
        cut_windows(scene_tracks(recording().filter(pl.col("frame") < 110)))
