"""Recordings read, prepared and pooled: what is written reads back the same.

The error for each kind of damage.
"""

import os
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from reference.recordings import damage_field, ngsim_rows, portal_csv, traffic, write_highd
from reference.refusals import user_error
from reference.scene_csv import write_scene_csv
from reference.synthetic import synthetic_scenes

from ganlane.commands.prepare import short_report
from ganlane.data import (
    SCHEMA,
    PooledStatistics,
    driving_statistics,
    read_recordings,
    read_scenes,
    scene_lane_counts,
    scene_lane_widths,
    write_prepared,
)
from ganlane.data.prepared import prepare_recordings
from ganlane.data.recordings import cut_into_scenes
from ganlane.data.schema import Scene
from ganlane.data.statistics import quantities
from ganlane.files import whole_folder, write_bytes

pytestmark = pytest.mark.usefixtures("empty_folder")
CAR = np.repeat([1, 2], 6)
FRAME = np.tile(np.arange(6), 2)
#: Two cars, one in the left lane (1) and one in the right (2), 3.5 m apart, at 10 m/s.
ROWS = pl.DataFrame(
    {
        "scene": "s",
        "vehicle": CAR,
        "frame": FRAME,
        "x": FRAME + 20.0 * CAR,
        "y": 3.5 - 3.5 * CAR,
        "heading": 0,
        "v": 10.0,
        "lane": CAR,
        "length": 4.5,
        "width": 2.0,
    }
)


def written(rows=ROWS):
    path = Path("scenes.csv")
    rows.write_csv(path)
    return path


def test_lanes_are_counted_from_the_right_y_from_the_right_lanes_centre_and_rows_are_sorted():
    frame = read_scenes(written())
    assert frame.schema == SCHEMA
    assert frame["lane"].to_list() == [1] * 6 + [0] * 6
    assert frame["y"].to_list() == pytest.approx([3.5] * 6 + [0.0] * 6)
    assert scene_lane_counts(frame) == {"s": 2}
    # The order of the file has no effect.
    assert read_scenes(written(ROWS.sort("frame"))).equals(frame)


@pytest.mark.parametrize(
    ("row", "column", "value", "message"),
    [
        (7, "lane", "0", r"line 9, column lane: 0 is below 1"),
        (8, "frame", "1", r"line 10, column frame: 1 comes twice"),
        (9, "frame", "0", r"line 11, column frame: 0 is before"),
        (10, "length", "0", r"line 12, column length: 0.0 is not above 0"),
    ],
)
def test_a_damaged_field_is_named_by_file_line_and_column(row, column, value, message):
    path = written()
    damage_field(path, column, row, value)
    with user_error(f"{path}, {message}"):
        read_scenes(path)


@pytest.mark.parametrize(
    ("column", "factor", "message"),
    [
        ("v", 10.0, "line 2, column speed: the median is 100.0"),
        (
            "v",
            3.6,
            "line 3, columns x and speed: x moves by 10.0 m per second where speed says 36.0",
        ),
        ("x", -1.0, "x moves by -10.0 m per second"),
        ("x", -1.5, "line 2, column x: its track runs backwards"),
        ("length", 3.28, "line 2, column length: the median is 14.8"),
        ("y", 3.28, "lanes are 11.48 m apart"),
        ("y", -1.0, "lanes are -3.50 m apart"),
    ],
)
def test_units_and_directions_that_cannot_be_are_refused(column, factor, message):
    with user_error(message):
        read_scenes(written(ROWS.with_columns(pl.col(column) * factor)))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            b"scene,vehicle,frame,x,y,speed\ns,1,0,0,0,10\n",
            r"line 1: no column v, lane.*found .*speed; expected",
        ),
        (ROWS.clear().write_csv().encode(), "a header but no rows"),
        (b"\x89PNG\r\n\x1a\n\x00\xff\xfe" * 50, r"line 1: not text"),
    ],
)
def test_files_without_columns_rows_or_text_are_refused(content, message):
    Path("scenes.csv").write_bytes(content)
    with user_error(message):
        read_scenes("scenes.csv")


@pytest.mark.parametrize("name", [".", "scenes.csv", "x.parquet"])
def test_absent_files_are_refused(name):
    # A folder without Parquet, a missing CSV, a missing Parquet file.
    Path("other.csv").write_text("scene")
    with user_error("no such file"):
        read_scenes(name)


def test_a_scene_in_two_files_is_refused():
    # Two scenes in one file, one of them in the other, too.
    write_prepared(synthetic_scenes(), "a.parquet")
    write_prepared(synthetic_scenes(scenes=1), "b.parquet")
    with user_error(r"b.parquet: scene synthetic-0 is in .*a.parquet too; remove one"):
        read_scenes(".")


def test_damaged_parquet_is_refused():
    path = Path("x.parquet")
    # No table at all, then a table with a wrong column.
    path.write_bytes(b"PAR1 not really")
    with user_error("not a readable Parquet file"):
        read_scenes(path)
    write_prepared(synthetic_scenes().with_columns(x=pl.lit(float("nan"))), path)
    with user_error(r"x.parquet, row 0, column x: nan is not a finite number"):
        read_scenes(path)


def test_a_recording_with_frames_missing_throughout_is_refused():
    frame = synthetic_scenes(scenes=2, vehicles=6, seconds=8.0)
    # One scene is whole; the other one has every second frame alone.
    there = (pl.col("scene") == "synthetic-0") | (pl.col("frame") % 2 == 0)
    write_scene_csv(frame.filter(there), "sparse.csv")
    with user_error(r"sparse.csv, line \d+, .*10 frames a second"):
        read_scenes("sparse.csv")


def test_scenes_one_by_one_say_what_they_say_together():
    frame = synthetic_scenes()
    together = driving_statistics(frame)
    widths = scene_lane_widths(frame)
    # One by one, as prepare does.
    apart = PooledStatistics()
    for (name,), rows in frame.group_by("scene", maintain_order=True):
        apart.add(Scene(name, rows, widths[name]))
    assert vars(apart.exposure) == pytest.approx(vars(together.exposure))
    assert apart.lane_changes.duration == together.lane_changes.duration
    for name in ("count", "per_vehicle_km", "srlc"):
        expected = getattr(together.lane_changes, name)
        assert getattr(apart.lane_changes, name) == pytest.approx(expected), name
    for name, values in quantities(frame).items():
        np.testing.assert_allclose(np.sort(apart.sample(name)), np.sort(values))


@pytest.fixture
def csv():
    """A scene CSV of two scenes."""
    write_scene_csv(synthetic_scenes(seed=5), "mine.csv")
    return "mine.csv"


def test_what_is_written_reads_back_the_same(csv):
    prepared = prepare_recordings("scenes", csv, "out")
    assert prepared.files == ["synthetic-0.parquet", "synthetic-1.parquet"]
    assert read_scenes("out").equals(read_scenes(csv))
    second = read_scenes(Path("out") / prepared.files[1])
    assert second["scene"].unique().to_list() == ["synthetic-1"]
    assert prepared.written == prepared.count.kept == synthetic_scenes(seed=5).height
    # What was prepared can be prepared again.
    again = prepare_recordings("scenes", "out", "again")
    assert again.to_dict()["rows"] == prepared.to_dict()["rows"]


def test_long_recordings_are_cut_into_scenes_when_written_and_measured_whole(csv):
    # Cutting would censor lane changes, so it comes after measuring.
    whole = prepare_recordings("scenes", csv, "whole").lane_changes
    cut = prepare_recordings("scenes", csv, "cut", scene_s=4.0)
    assert cut.lane_changes == whole
    scenes = read_scenes("cut")
    per_scene = scenes.group_by("scene", maintain_order=True).agg(pl.col("frame").n_unique())
    assert per_scene.rows() == [
        (f"synthetic-{number}-00{part}", frames)
        for number in range(2)
        for part, frames in enumerate((40, 40, 20))
    ]
    assert cut_into_scenes(scenes, 100.0)["scene"].n_unique() == 6


def test_reports_state_rows_rates_and_durations():
    rows = ngsim_rows(traffic(scenes=1))
    # One row comes twice.
    Path("portal.csv").write_text(portal_csv(pl.concat((rows, rows[5]))))
    report = short_report(prepare_recordings("ngsim", "portal.csv", "out"))
    assert "541 read, 540 kept, 540 written" in report
    assert "dropped: 1 (duplicate)" in report
    assert "lane changes: 0; 0.000 per vehicle and km of road (equation 9)" in report


def refused(frame, message):
    write_prepared(frame, "a.parquet")
    with user_error(message):
        prepare_recordings("scenes", ".", "out")


def test_the_output_folder_appears_only_when_everything_was_written():
    # Of two files the second is damaged.
    Path("b.parquet").write_bytes(b"PAR1")
    refused(synthetic_scenes(), "b.parquet: not a readable")
    assert sorted(os.listdir()) == ["a.parquet", "b.parquet"]
    precious = Path("out") / "precious"
    precious.parent.mkdir()
    precious.write_text("")
    refused(synthetic_scenes(), r"out: there already; choose another folder with out=FOLDER")
    assert precious.exists()


def test_parked_cars_and_names_that_differ_in_a_blank_alone_are_refused():
    # Nobody moves in any scene.
    parked = synthetic_scenes().with_columns(
        speed=pl.lit(0.0), x=pl.col("x").first().over("scene", "vehicle")
    )
    refused(parked, "no scene in which anybody drives")
    names = pl.col("scene").replace({"synthetic-0": "my road", "synthetic-1": "my_road"})
    message = r"a second scene that my_road.parquet is the file of"
    refused(synthetic_scenes().with_columns(names), message)


def test_recordings_without_vehicles_on_the_lanes_are_refused():
    write_highd(Path())
    # A lane number that neither direction has.
    tracks = Path("01_tracks.csv")
    pl.read_csv(tracks).with_columns(laneId=pl.lit(9)).write_csv(tracks)
    with user_error("no vehicle on any of the lanes kept"):
        read_recordings("highd", ".")


def test_an_error_names_the_folder_to_be_and_other_files_as_they_are():
    out = Path("scenes")
    too_long = "s" * 300
    with pytest.raises(OSError, match="too long") as caught, whole_folder(out) as folder:
        write_bytes(folder / too_long, b"")
    assert caught.value.filename == str(out / too_long)
    with pytest.raises(FileNotFoundError) as caught, whole_folder(out):
        Path("absent").read_bytes()
    assert caught.value.filename == "absent"
    assert os.listdir() == []
