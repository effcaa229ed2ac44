"""Scene CSV and Parquet: what is read, and the error for each kind of damage."""

from pathlib import Path

import polars as pl
import pytest

from ganlane.data import (
    SCHEMA,
    SyntheticTraffic,
    read_scenes,
    scene_lane_counts,
    synthetic_scenes,
    validate,
    write_prepared,
    write_scene_csv,
)
from ganlane.errors import UserError

HEADER = "scene,vehicle,frame,x,y,heading,v,lane,length,width"
#: Two cars, one in the left lane (1) and one in the right (2), 3.5 m apart, at 10 m/s.
ROWS = [
    f"s,{vehicle},{frame},{frame * 1.0 + 20 * vehicle},{-3.5 * (vehicle - 1)},0,10,{vehicle},4.5,2.0"
    for vehicle in (1, 2)
    for frame in range(6)
]


def written(folder: Path, lines: list[str]) -> Path:
    path = folder / "scenes.csv"
    path.write_text("\n".join([HEADER, *lines]) + "\n")
    return path


def test_lanes_are_counted_from_the_right_and_y_from_the_right_lanes_centre(tmp_path):
    frame = read_scenes(written(tmp_path, ROWS))
    assert frame.schema == SCHEMA
    left = frame.filter(pl.col("vehicle") == 1)
    right = frame.filter(pl.col("vehicle") == 2)
    assert left["lane"].to_list() == [1] * 6
    assert right["lane"].to_list() == [0] * 6
    assert left["y"].to_list() == pytest.approx([3.5] * 6)
    assert right["y"].to_list() == pytest.approx([0.0] * 6)
    assert scene_lane_counts(frame) == {"s": 2}


def test_rows_come_out_sorted_whatever_their_order_across_tracks(tmp_path):
    by_frame = sorted(ROWS, key=lambda row: int(row.split(",")[2]))
    assert read_scenes(written(tmp_path, by_frame)).equals(read_scenes(written(tmp_path, ROWS)))


def test_a_synthetic_recording_survives_the_file(tmp_path):
    made = synthetic_scenes(seed=3)
    path = tmp_path / "made.csv"
    write_scene_csv(made, path)
    read = read_scenes(path)
    exact = ["scene", "vehicle", "frame", "lane"]
    assert read.select(exact).equals(made.select(exact))
    for name, tolerance in {"x": 1e-4, "speed": 1e-4, "length": 1e-9, "width": 1e-9}.items():
        assert (read[name] - made[name]).abs().max() <= tolerance
    # The lane width is estimated anew, to 4 cm; two lanes to the left that makes 8 cm.
    assert (read["y"] - made["y"]).abs().max() < 0.08


def field(row: int, column: str, value: str) -> list[str]:
    lines = [line.split(",") for line in ROWS]
    lines[row][HEADER.split(",").index(column)] = value
    return [",".join(line) for line in lines]


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (field(3, "x", "abc"), r"line 5, column x: 'abc' is not a number"),
        (field(0, "y", "NaN"), r"line 2, column y: 'NaN' is not a finite number"),
        (field(4, "frame", "4.5"), r"line 6, column frame: '4.5' is not a whole number"),
        (field(5, "lane", ""), r"line 7, column lane: the field is empty"),
        (field(7, "lane", "0"), r"line 9, column lane: 0 is below 1"),
        (field(8, "frame", "1"), r"line 10, column frame: 1 comes twice"),
        (field(9, "frame", "0"), r"line 11, column frame: 0 is before"),
        (field(10, "length", "0"), r"line 12, column length: 0.0 is not above 0"),
        ([*ROWS[:-1], "s,2,5,45.0"], r"line 13, column x: the row ends after 4 of 10 fields"),
    ],
)
def test_a_damaged_field_is_named_by_file_line_and_column(tmp_path, lines, message):
    path = written(tmp_path, lines)
    with pytest.raises(UserError, match=message) as caught:
        read_scenes(path)
    assert str(path) in str(caught.value)


def scaled(column: str, factor: float) -> list[str]:
    at = HEADER.split(",").index(column)
    lines = [line.split(",") for line in ROWS]
    return [",".join([*line[:at], str(float(line[at]) * factor), *line[at + 1 :]]) for line in lines]


@pytest.mark.parametrize(
    ("column", "factor", "message"),
    [
        ("v", 10.0, "line 2, column speed: the median is 100.0"),
        ("v", 3.6, "line 3, columns x and speed: x moves by 10.0 m per second where speed says 36.0"),
        ("x", 3.28, "x moves by 32.8 m per second where speed says 10.0"),
        ("x", -1.0, "x moves by -10.0 m per second"),
        ("length", 3.28, "line 2, column length: the median is 14.8"),
        ("y", 3.28, "lanes are 11.48 m apart"),
        ("y", -1.0, "lanes are -3.50 m apart"),
    ],
)
def test_units_and_directions_that_cannot_be_are_refused(tmp_path, column, factor, message):
    with pytest.raises(UserError, match=message):
        read_scenes(written(tmp_path, scaled(column, factor)))


def test_a_missing_column_names_what_was_found_and_expected(tmp_path):
    path = tmp_path / "scenes.csv"
    path.write_text("scene,vehicle,frame,x,y,speed,lane,length,width\n" + "s,1,0,0,0,10,1,4,2\n")
    with pytest.raises(UserError, match=r"line 1: no column v; found scene.*speed.*expected"):
        read_scenes(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (HEADER.encode() + b"\n", "a header but no rows"),
        (b"\x89PNG\r\n\x1a\n\x00\xff\xfe" * 50, r"line 1: not text"),
    ],
)
def test_files_without_rows_or_text_are_refused(content, message, tmp_path):
    (tmp_path / "scenes.csv").write_bytes(content)
    with pytest.raises(UserError, match=message):
        read_scenes(tmp_path / "scenes.csv")


@pytest.mark.parametrize("name", ["", "scenes.csv", "x.parquet"])
def test_absent_files_are_refused(name, tmp_path):
    (tmp_path / "other.csv").write_text("scene")
    with pytest.raises(UserError, match="no such file"):
        read_scenes(tmp_path / name)


def test_a_scene_in_two_files_is_refused(tmp_path):
    write_prepared(synthetic_scenes(), tmp_path / "a.parquet")
    write_prepared(synthetic_scenes(SyntheticTraffic(scenes=1)), tmp_path / "b.parquet")
    with pytest.raises(UserError, match=r"b.parquet: scene synthetic-0 is in .*a.parquet too; remove one"):
        read_scenes(tmp_path)


def test_damaged_parquet_is_refused(tmp_path):
    path = tmp_path / "x.parquet"
    path.write_bytes(b"PAR1 not really")
    with pytest.raises(UserError, match="not a readable Parquet file"):
        read_scenes(path)
    made = synthetic_scenes()
    write_prepared(made.drop("speed"), path)
    with pytest.raises(UserError, match=r"x.parquet: no column speed"):
        read_scenes(path)
    write_prepared(made.with_columns(x=pl.lit(float("nan"))), path)
    with pytest.raises(UserError, match=r"x.parquet, row 0, column x: nan is not a finite number"):
        read_scenes(path)


def test_the_validator_checks_frames_that_come_from_nowhere():
    made = synthetic_scenes(SyntheticTraffic(scenes=1))
    assert validate(made, "made").equals(made)
    holed = made.with_columns(x=pl.when(pl.int_range(pl.len()) == 7).then(None).otherwise("x"))
    for wrong, message in (
        (made.drop("speed"), "made: no column speed"),
        (made.clear(), "made: no rows"),
        (made.with_columns(x=pl.lit("here")), "made, column x: String found, Float64 expected"),
        (holed, "made, line 9, column x: None is not a finite number"),
    ):
        with pytest.raises(UserError, match=message):
            validate(wrong, "made")


@pytest.mark.parametrize(("kept", "renumbered"), [(2, False), (5, False), (2, True), (3, True)])
def test_recordings_with_frames_missing_throughout_are_refused(kept, renumbered, tmp_path):
    frame = synthetic_scenes(SyntheticTraffic(scenes=2, vehicles=6, seconds=8.0))
    # One scene is whole; the other one has every second frame alone, or so.
    sparse = (pl.col("scene") == frame["scene"].max()) | renumbered
    frame = frame.filter(~sparse | (pl.col("frame") % kept == 0))
    if renumbered:
        frame = frame.with_columns(frame=pl.col("frame") // kept)
    write_scene_csv(frame, tmp_path / "sparse.csv")
    with pytest.raises(UserError, match=r"sparse.csv, line \d+, .*10 frames a second"):
        read_scenes(tmp_path / "sparse.csv")
