"""Recordings read, prepared and pooled: what is written reads back the same.

The error for each kind of damage.
"""

from __future__ import annotations

import os
from pathlib import Path

import polars as pl
import pytest
from reference.recordings import ngsim_rows, portal_csv, traffic, write_highd
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
from ganlane.data.statistics import describe
from ganlane.files import whole_folder, write_bytes

pytestmark = pytest.mark.usefixtures("empty_folder")
HEADER = "scene,vehicle,frame,x,y,heading,v,lane,length,width"
#: Two cars, one in the left lane (1) and one in the right (2), 3.5 m apart, at 10 m/s.
ROWS = [
    f"s,{vehicle},{frame},{frame * 1.0 + 20 * vehicle},{-3.5 * (vehicle - 1)},0,10,{vehicle},4.5,2"
    for vehicle in (1, 2)
    for frame in range(6)
]


def written(lines: list[str]) -> Path:
    path = Path("scenes.csv")
    path.write_text("\n".join([HEADER, *lines]) + "\n")
    return path


def changed(column: str, change, only: int | None = None) -> list[str]:
    """The lines with ``change`` applied to the ``column`` of all rows, or of one."""
    lines = [dict(zip(HEADER.split(","), line.split(","))) for line in ROWS]
    for line in lines if only is None else [lines[only]]:
        line[column] = change(line[column])
    return [",".join(line.values()) for line in lines]


def test_lanes_are_counted_from_the_right_y_from_the_right_lanes_centre_and_rows_are_sorted():
    frame = read_scenes(written(ROWS))
    assert frame.schema == SCHEMA
    assert frame["lane"].to_list() == [1] * 6 + [0] * 6
    assert frame["y"].to_list() == pytest.approx([3.5] * 6 + [0.0] * 6)
    assert scene_lane_counts(frame) == {"s": 2}
    # The order of the file has no effect.
    by_frame = sorted(ROWS, key=lambda row: int(row.split(",")[2]))
    assert read_scenes(written(by_frame)).equals(frame)


def test_a_track_that_runs_backwards_is_refused():
    path = written(changed("x", lambda x: str(100.0 - 1.5 * float(x))))
    with user_error("line 2, column x: its track runs backwards"):
        read_scenes(path)


@pytest.mark.parametrize(
    ("row", "column", "value", "message"),
    [
        (7, "lane", "0", r"line 9, column lane: 0 is below 1"),
        (8, "frame", "1", r"line 10, column frame: 1 comes twice"),
        (9, "frame", "0", r"line 11, column frame: 0 is before"),
        (10, "length", "0", r"line 12, column length: 0.0 is not above 0"),
        (11, "x", "here", r"line 13, column x: 'here' is not a number"),
    ],
)
def test_a_damaged_field_is_named_by_file_line_and_column(row, column, value, message):
    path = written(changed(column, lambda _: value, row))
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
        ("length", 3.28, "line 2, column length: the median is 14.8"),
        ("y", 3.28, "lanes are 11.48 m apart"),
        ("y", -1.0, "lanes are -3.50 m apart"),
    ],
)
def test_units_and_directions_that_cannot_be_are_refused(column, factor, message):
    with user_error(message):
        read_scenes(written(changed(column, lambda field: str(float(field) * factor))))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            b"scene,vehicle,frame,x,y,speed\ns,1,0,0,0,10\n",
            r"line 1: no column v, lane.*found .*speed; expected",
        ),
        (HEADER.encode() + b"\n", "a header but no rows"),
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
    # From no table at all to a single wrong field.
    path.write_bytes(b"PAR1 not really")
    with user_error("not a readable Parquet file"):
        read_scenes(path)
    frame = synthetic_scenes()
    write_prepared(frame.drop("speed"), path)
    with user_error(r"x.parquet: no column speed"):
        read_scenes(path)
    write_prepared(frame.with_columns(x=pl.lit(float("nan"))), path)
    with user_error(r"x.parquet, row 0, column x: nan is not a finite number"):
        read_scenes(path)


@pytest.mark.parametrize(("every", "renumbered"), [(2, False), (3, True)])
def test_recordings_with_frames_missing_throughout_are_refused(every, renumbered):
    frame = synthetic_scenes(scenes=2, vehicles=6, seconds=8.0)
    # One scene is whole; the other one has every second frame alone, or so.
    sparse = (pl.col("scene") == frame["scene"].max()) | renumbered
    frame = frame.filter(~sparse | (pl.col("frame") % every == 0))
    if renumbered:
        frame = frame.with_columns(frame=pl.col("frame") // every)
    write_scene_csv(frame, "sparse.csv")
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
    for name in ("speed", "acceleration_raw", "acceleration_smoothed", "headway"):
        one = describe(apart.sample(name))
        other = getattr(together, name)
        numbers = (other.count, other.mean, other.sd)
        assert (one.count, one.mean, one.sd) == pytest.approx(numbers), name
        assert one.quantiles == pytest.approx(other.quantiles), name


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
    assert per_scene["scene"].to_list() == [
        f"synthetic-{k}-00{part}" for k in range(2) for part in range(3)
    ]
    assert per_scene["frame"].to_list() == [40, 40, 20] * 2
    assert cut_into_scenes(scenes, 100.0)["scene"].n_unique() == 6


def ngsim_lines(thousands: bool = True) -> list[str]:
    """One scene as the portal's CSV."""
    rows = ngsim_rows(traffic().filter(pl.col("scene") == "synthetic-0"))
    return portal_csv(rows, thousands=thousands).splitlines()


def test_reports_state_rows_rates_and_durations():
    path = Path("portal.csv")
    lines = ngsim_lines()
    # One row comes twice.
    path.write_text("\n".join([*lines, lines[5], ""]))
    prepared = prepare_recordings("ngsim", path, "out")
    report = short_report(prepared)
    assert "541 read, 540 kept, 540 written" in report
    assert "dropped: 1 (duplicate)" in report
    assert "lane changes: 0; 0.000 per vehicle and km of road (equation 9)" in report


def test_the_output_folder_appears_only_when_everything_was_written():
    lines = ngsim_lines(thousands=False)
    # The last row is damaged.
    Path("bad.csv").write_text("\n".join([*lines, lines[-1].replace(",", ",x", 1)]))
    with user_error("line 542"):
        prepare_recordings("ngsim", "bad.csv", "out")
    assert os.listdir() == ["bad.csv"]
    precious = Path("out") / "precious"
    precious.parent.mkdir()
    precious.write_text("")
    with user_error(r"out: there already; choose another folder with out=FOLDER"):
        prepare_recordings("ngsim", "bad.csv", "out")
    assert precious.exists()


def refused(frame: pl.DataFrame, message: str) -> None:
    write_prepared(frame, "a.parquet")
    with user_error(message):
        prepare_recordings("scenes", "a.parquet", "out")


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
