"""NGSIM files, generated from synthetic recordings.

What is read, in how many blocks, and errors in damaged files.
"""

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from reference.recordings import (
    LANE_M,
    START_MS,
    damage_field,
    ngsim_rows,
    portal_csv,
    raw_text,
    traffic,
)
from reference.refusals import user_error

from ganlane.data import SCHEMA, read_recordings
from ganlane.data.ngsim import ngsim_scenes
from ganlane.data.schema import RowCount
from ganlane.settings.generator import NgsimParameters

pytestmark = pytest.mark.usefixtures("empty_folder")
WHOLE = NgsimParameters()
#: A file takes several.
SMALL_BLOCKS = NgsimParameters(block_bytes=20_000)
#: Two periods of one place: the same vehicle and frame numbers again.
FIRST, SECOND = traffic().partition_by("scene", maintain_order=True)


def text_file(rows):
    path = Path("trajectories-0750am-0805am.txt")
    path.write_bytes(raw_text(rows).encode())
    return path


def portal_file(content):
    path = Path("portal.csv")
    path.write_text(content)
    return path


def same_driving(read, expected):
    expected = expected.sort("vehicle", "frame")
    numbers = expected.drop("scene", "y")
    np.testing.assert_allclose(read.select(numbers.columns), numbers, atol=1e-5)
    # Lane width and the first lane's centre are estimated from positions that wander by 0.15 m.
    np.testing.assert_allclose(read["y"], expected["y"], atol=0.2)


def test_raw_text_gives_back_the_recording_in_metres_from_centres_and_from_the_right():
    path = text_file(ngsim_rows(FIRST))
    (scene,) = ngsim_scenes(path, WHOLE, RowCount())
    assert (scene.name, scene.lanes) == ("trajectories-0750am-0805am-1", 3)
    assert scene.frame.schema == SCHEMA
    assert scene.lane_width_m == pytest.approx(LANE_M, abs=0.1)
    same_driving(scene.frame, FIRST)
    assert read_recordings("ngsim", path).equals(scene.frame)
    with user_error("moon: no such kind of recordings; expected scenes, ngsim or highd"):
        read_recordings("moon", path)


@pytest.mark.parametrize("block_bytes", [10_000, 2**25])
def test_the_portals_periods_are_separated_by_time_in_any_order_and_blocks(block_bytes):
    # In any order, since the portal does not promise one.
    rows = pl.concat((ngsim_rows(FIRST), ngsim_rows(SECOND, START_MS + 900_000))).sample(
        fraction=1.0, shuffle=True, seed=1
    )
    path = portal_file(portal_csv(rows))
    count = RowCount()
    scenes = list(ngsim_scenes(path, NgsimParameters(block_bytes=block_bytes), count))
    assert [scene.name for scene in scenes] == ["us-101-1", "us-101-2"]
    same_driving(scenes[0].frame, FIRST)
    same_driving(scenes[1].frame, SECOND)
    assert (count.read, count.kept) == (1080, 1080)


def test_duplicates_and_other_places_are_dropped_and_counted():
    rows = ngsim_rows(FIRST)
    # The same vehicle and time, at another speed.
    other = rows.head(1).with_columns(v_Vel=pl.lit(9.0))
    content = portal_csv(pl.concat((rows, rows.head(30), other)))
    _, _, elsewhere = portal_csv(rows.head(7), "lankershim").partition("\n")
    count = RowCount()
    scenes = list(ngsim_scenes(portal_file(content + elsewhere), WHOLE, count))
    same_driving(scenes[0].frame, FIRST)
    assert dict(count.dropped) == {
        "location lankershim": 7,
        "duplicate": 30,
        "same vehicle and time, other values": 1,
    }
    assert (count.read, count.kept) == (540 + 38, 540)


def test_ramps_are_left_out_and_end_a_track():
    rows = ngsim_rows(FIRST)
    # NGSIM numbers ramps from 7 on.
    on_ramp = (pl.col("Vehicle_ID") == 2) & pl.col("Frame_ID").is_between(20, 29)
    rows = rows.with_columns(Lane_ID=pl.when(on_ramp).then(7).otherwise("Lane_ID"))
    count = RowCount()
    (scene,) = ngsim_scenes(text_file(rows), WHOLE, count)
    assert dict(count.dropped) == {"ramp": 10}
    frames = dict(scene.frame.group_by("vehicle").agg("frame").iter_rows())
    assert frames[2] == list(range(20))
    assert frames[10_002] == list(range(30, 60))


def changed(row, column, value):
    """The portal's file with one field changed."""
    path = portal_file(portal_csv(ngsim_rows(FIRST)))
    damage_field(path, column, row, value)
    return path


@pytest.mark.parametrize(
    ("row", "column", "value", "message"),
    [
        (400, "v_vel", "-3.0", r"line 402, column v_vel: -3.0 is below 0"),
        (8, "v_length", "0", r"line 10, column v_length: 0.0 is not above 0"),
        (6, "location", "us-10", r"line 8, column location: 'us-10' is no known place"),
        (
            9,
            "frame_id",
            "9000000",
            r"line 11, columns frame_id and global_time: frame 9000000 .* fits no recording",
        ),
        (9, "frame_id", "7", r"line 11, column frame_id: 7 does not grow with global_time"),
        (
            9,
            "global_time",
            f"{START_MS + 950}",
            r"line 11, column global_time: .* is not 100 ms a frame",
        ),
    ],
)
def test_a_damaged_field_is_named_by_file_line_and_column(row, column, value, message):
    path = changed(row, column, value)
    with user_error(f"{path}, {message}"):
        read_recordings("ngsim", path, SMALL_BLOCKS)


def test_a_truncated_text_is_refused():
    path = text_file(ngsim_rows(FIRST))
    path.write_bytes(path.read_bytes()[:-30])
    with user_error(r"line 540, column \w+: the row has .* fields, expected 18"):
        read_recordings("ngsim", path)


@pytest.mark.parametrize(
    ("columns", "factor", "message"),
    [
        (
            ("Local_X", "Local_Y", "v_length", "v_Width", "v_Vel"),
            0.3048,
            "column v_length: .*they look like metres",
        ),
        (("v_Vel",), 1.09728, "columns local_y and v_vel: vehicles cover 0.91 times"),
        (("v_Vel",), 0.681818, "columns local_y and v_vel: vehicles cover 1.47 times"),
        (("v_length",), 30.48, "column v_length: .*they look like centimetres or inches"),
    ],
)
def test_units_that_cannot_be_feet_and_seconds_are_refused(columns, factor, message):
    # All else stays in feet.
    rows = ngsim_rows(FIRST).with_columns(pl.col(name) * factor for name in columns)
    with user_error(f"line 1, {message}"):
        read_recordings("ngsim", text_file(rows))


def test_files_of_other_columns_or_places_are_refused():
    with user_error(r"line 1: 17 columns; expected the 18"):
        read_recordings("ngsim", text_file(ngsim_rows(FIRST).drop("v_Class")))
    with user_error(r"no rows of us-101, i-80; check data.locations"):
        read_recordings("ngsim", portal_file(portal_csv(ngsim_rows(FIRST), "peachtree")))


def test_temporary_files_are_removed_after_an_error():
    path = changed(500, "local_y", "far")
    scratch = Path("scratch")
    # The damage is late in the file, when blocks are on the disk.
    scratch.mkdir()
    with user_error("'far' is not a number"):
        list(ngsim_scenes(path, SMALL_BLOCKS, RowCount(), scratch))
    assert list(scratch.iterdir()) == []
