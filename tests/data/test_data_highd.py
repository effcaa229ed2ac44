"""highD recordings, made by hand.

Two directions of travel, seen as their drivers see them, at 10 Hz.
"""

import numpy as np
import polars as pl
import pytest
from reference.recordings import damage_field, write_highd
from reference.refusals import user_error

from ganlane.data import SCHEMA, read_recordings
from ganlane.data.highd import highd_scenes
from ganlane.data.schema import RowCount


@pytest.fixture
def recording(tmp_path):
    write_highd(tmp_path)
    return tmp_path / "01_tracks.csv"


def assert_refused(path, sentence):
    with user_error(sentence):
        read_recordings("highd", path)


def test_each_direction_is_a_scene_at_10_hz_with_x_forward_and_lane_0_rightmost(recording):
    upper, lower = highd_scenes(recording, RowCount())
    assert (upper.name, lower.name) == ("highd-01-upper", "highd-01-lower")
    # Upwards in the picture is to the right for those who drive to the left: lanes 2 (y 8 to 12)
    # and 3. Lower lanes: 5 (y 20 to 24) is the left one, 6 the right one; left is up.
    expected = {1: (0, 0.0, 30.0), 2: (1, 4.5, 35.0), 3: (0, 0.0, 25.0), 4: (1, 4.0, 28.0)}
    # Where each vehicle is first.
    begin = {}
    for scene in (upper, lower):
        assert (scene.frame.schema, scene.lane_width_m) == (SCHEMA, 4.0)
        assert 0.0 <= scene.frame["x"].min() < 4.0
        for (vehicle,), rows in scene.frame.group_by("vehicle"):
            begin[vehicle] = rows["x"][0]
            lane, y, speed = expected[vehicle]
            assert rows["lane"].unique().to_list() == [lane]
            numbers = rows.select("y", "length", "width", "speed").row(0)
            assert numbers == pytest.approx((y, 5.0, 2.0, speed))
            assert np.diff(rows["x"].to_numpy()) / 0.1 == pytest.approx(speed)
            # Recorded are the frames 1 to 200 at 25 Hz, 0.04 to 8 s.
            assert rows["frame"].to_list() == list(range(1, 81))
    assert begin.keys() == expected.keys()
    # Car 2 starts 20 m further to the left than car 1, that is ahead of it; both are read at 0.1 s,
    # frame 2.5.
    assert begin[2] - begin[1] == pytest.approx(20.0 + 0.06 * 5.0)


def test_a_folder_is_read_recording_by_recording(tmp_path):
    write_highd(tmp_path, "01")
    # The second recording is half as long.
    write_highd(tmp_path, "02", seconds=4.0)
    count = RowCount()
    names = [scene.name for scene in highd_scenes(tmp_path, count)]
    assert names == ["highd-01-upper", "highd-01-lower", "highd-02-upper", "highd-02-lower"]
    assert (count.read, count.kept) == (4 * 300, 4 * 300)


def test_rows_off_the_lanes_are_dropped_and_end_a_track(recording):
    rows = pl.read_csv(recording)
    aside = (pl.col("id") == 3) & pl.col("frame").is_between(80, 90)
    rows.with_columns(laneId=pl.when(aside).then(7).otherwise("laneId")).write_csv(recording)
    count = RowCount()
    _, lower = highd_scenes(recording, count)
    assert dict(count.dropped) == {"off the lanes of its direction": 11}
    # Car 3 comes back as a track of its own.
    assert sorted(lower.frame["vehicle"].unique()) == [3, 4, 10_003]


@pytest.mark.parametrize(
    ("column", "row", "value", "message"),
    [
        ("frame", 6, "4", r"line 8, column frame: 4 is not after the last frame"),
        ("id", 250, "77", r"line 252, column id: 77 is not in the tracksMeta file"),
        ("width", 0, "0", r"line 2, column width: 0.0 is not above 0"),
    ],
)
def test_a_damaged_field_is_named(recording, column, row, value, message):
    damage_field(recording, column, row, value)
    assert_refused(recording, f"01_tracks.csv, {message}")


def test_units_that_cannot_be_are_refused(recording):
    # In km/h.
    pl.read_csv(recording).with_columns(pl.col("xVelocity") * 3.6).write_csv(recording)
    assert_refused(recording, r"highd-01-upper.*column speed: the median is 1\d\d")


def test_the_metadata_files_are_required_and_checked(recording):
    meta = recording.with_name("01_recordingMeta.csv")
    # First the markings, then files that are not there.
    damage_field(meta, "upperLaneMarkings", 0, "8.0;moon")
    assert_refused(recording, r"recordingMeta.csv, line 2, column upperlanemarkings: '8.0;moon'")
    meta.unlink()
    assert_refused(recording, r"01_recordingMeta.csv: no such file")
    write_highd(recording.parent)
    damage_field(recording.with_name("01_tracksMeta.csv"), "drivingDirection", 1, "3")
    assert_refused(recording, r"01_tracksMeta.csv, line 3, column drivingdirection: 3 is neither")
    assert_refused(recording.parent.parent, r"no XX_tracks.csv in this folder")
