"""NGSIM recordings: raw text files and the data portal's CSV, in feet, converted into the schema.

Feet become metres; the front centre becomes the centre of the body; lanes, which NGSIM counts from
the left, are counted from the right, and ``y``, in NGSIM positive to the right from the left edge,
is positive to the left from the rightmost lane's centre. Rows on ramps (lanes beyond ``lanes``) are
dropped, since a ramp is not parallel to the lanes. US-101's auxiliary lane (6) is kept, as the
rightmost. A car's track ends where a frame is missing or a ramp begins.

Vehicle and frame numbers start again in every recording period;
``global_time - 100 ms * frame_id``, the time of frame 0, is the same for all rows of one. Rows are
stored on disk by the minute of that time, block by block; adjacent minutes are one period. So
memory holds one block, then one period, and tracks that extend over blocks are not cut.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import polars as pl

from ganlane.data.lanes import lane_grid
from ganlane.data.schema import RowCount, Scene, number_tracks, sort
from ganlane.data.tables import (
    LINE,
    OnProgress,
    TextTable,
    convert,
    converted,
    csv_table,
    first_line,
    raise_unless_positive,
    raise_where,
    read_blocks,
)
from ganlane.errors import UserError
from ganlane.settings.generator import MOTORWAYS, NgsimParameters

#: Metres in a foot.
FOOT_M = 0.3048
#: Time between two frames, ms.
FRAME_MS = 100
#: The 18 columns of the raw text files, which have no header.
RAW_NAMES = (
    "vehicle_id",
    "frame_id",
    "total_frames",
    "global_time",
    "local_x",
    "local_y",
    "global_x",
    "global_y",
    "v_length",
    "v_width",
    "v_class",
    "v_vel",
    "v_acc",
    "lane_id",
    "preceding",
    "following",
    "space_headway",
    "time_headway",
)
#: Columns that are read; ``location`` too, where it exists.
COLUMNS = {
    **dict.fromkeys(("vehicle_id", "frame_id", "global_time"), pl.Int64),
    **dict.fromkeys(("local_x", "local_y", "v_length", "v_width", "v_vel"), pl.Float64),
    "lane_id": pl.Int64,
}
LOCATION = "location"
#: Further locations in the portal's file: streets with intersections.
STREETS = ("lankershim", "peachtree")
#: A file has about six periods; a damaged column of times or frames makes hundreds, or one of a few
#: rows. The least number of rows, where there are several periods, are those of a vehicle for 5 s.
MAX_PERIODS = 500
MIN_ROWS = 50
#: Maximum number of rows from which lane width and position are estimated.
ROWS_FOR_LANES = 500_000
#: Medians of vehicle lengths that can be feet: 15 is usual, 4.5 would be metres, 450 centimetres.
LENGTHS_FT = (8.0, 40.0)
#: Distance covered divided by speed times time. Recordings give 1.00; km/h give 0.91, miles per
#: hour 1.47.
PACE = (0.94, 1.06)
#: The pace is measured on tracks of at least 2 s at 10 ft/s or more.
_PACE_FRAMES = 20
_PACE_FT_S = 10.0


def ngsim_scenes(
    path: str | Path,
    parameters: NgsimParameters,
    count: RowCount,
    scratch: Path | None = None,
    on_progress: OnProgress | None = None,
) -> Iterator[Scene]:
    """The periods of an NGSIM file, one scene each, in bounded memory (a block, then a period).

    Args:
        path: a raw text file (18 columns, no header), or a CSV with NGSIM's column names in any
            case and order; with a column ``location`` it may hold several locations.
        parameters: locations and lanes that are wanted, and bytes of a block.
        count: rows read and dropped are added to it.
        scratch: folder for temporary files, which are removed at the end; None: the system's.
        on_progress: called after each block.

    Raises:
        UserError: a missing or damaged file; the message names file, line and column.
    """
    path = Path(path)
    # Nothing is read before the first period is asked for.
    rows = _read_rows(_layout(path), parameters, count, on_progress)
    with tempfile.TemporaryDirectory(dir=scratch, prefix="rows-") as folder:
        periods = _store_by_period(rows, Path(folder), str(path))
        if not periods:
            raise UserError(
                f"{path}: no rows of {', '.join(parameters.locations)}; check data.locations."
            )
        for name, parts in periods.items():
            scene = _scene(name, _read(parts), path, parameters.lanes, count)
            if scene is not None:
                yield scene


def _layout(path: Path) -> TextTable:
    """Raw text if the first line begins with a number and has no comma, else a CSV."""
    first = first_line(path)
    fields = first.split()
    if "," in first or not fields[0].replace(".", "", 1).isdecimal():
        return csv_table(path, COLUMNS)
    if len(fields) != len(RAW_NAMES):
        raise UserError(
            f"{path}, line 1: {len(fields)} columns; expected the {len(RAW_NAMES)} of NGSIM's text "
            "files, or a header line."
        )
    return TextTable(path, RAW_NAMES, blanks=True)


def _read_rows(
    table: TextTable,
    parameters: NgsimParameters,
    count: RowCount,
    on_progress: OnProgress | None,
) -> Iterator[pl.DataFrame]:
    """Blocks with :data:`COLUMNS`, ``location`` and ``line``, in feet, in the order of the file."""
    path = table.path
    has_location = LOCATION in table.names
    wanted = list(COLUMNS)
    if has_location:
        wanted.append(LOCATION)
    for text in read_blocks(table, wanted, parameters.block_bytes, on_progress):
        count.read += text.height
        if has_location:
            text = _keep_locations(text, path, parameters.locations, count)
        else:
            # A raw text file is of one place, which its name tells.
            text = text.with_columns(pl.lit(path.stem).alias(LOCATION))

        # Only the wanted rows are converted: others may be damaged.
        rows = converted(text, COLUMNS, path).with_columns(text[LOCATION])
        raise_unless_positive(rows, ("v_length", "v_width"), path)
        raise_where(rows["v_vel"] < 0.0, rows, "v_vel", path, "is below 0")
        yield rows


def _keep_locations(
    text: pl.DataFrame,
    path: Path,
    locations: tuple[str, ...],
    count: RowCount,
) -> pl.DataFrame:
    """Rows of the wanted locations; rows of others are dropped and counted."""
    text = text.with_columns(convert(text, LOCATION, pl.String, path).str.to_lowercase())
    places = sorted({*MOTORWAYS, *STREETS, *locations})
    what = f"is no known place, expected {', '.join(places)}, or name it in data.locations"
    # A mistyped place would drop a whole recording in silence.
    raise_where(~text[LOCATION].is_in(places), text, LOCATION, path, what)

    wanted = text[LOCATION].is_in(list(locations))
    for location, rows in text[LOCATION].filter(~wanted).value_counts().iter_rows():
        count.drop(f"location {location}", rows)
    return text.filter(wanted)


def _store_by_period(
    blocks: Iterable[pl.DataFrame],
    folder: Path,
    source: str,
) -> dict[str, list[Path]]:
    """Store the rows of all blocks under ``folder``.

    Args:
        blocks: rows as :func:`_read_rows` gives them.
        folder: where files are written.
        source: name of the recording, for messages.

    Returns:
        The files of each period by its name, as ``us-101-1``.

    Raises:
        UserError: times or frames that make no periods.
    """
    # By location and minute of frame 0.
    parts: dict[tuple[Any, ...], list[Path]] = {}
    # The time of frame 0, the same for all rows of a period.
    start_ms = pl.col("global_time") - FRAME_MS * pl.col("frame_id")
    for number, block in enumerate(blocks):
        block = block.with_columns(minute=start_ms // 60_000)
        minutes = block.partition_by(LOCATION, "minute", as_dict=True, include_key=False)
        for period, rows in minutes.items():
            # Numbered by block: the rows of a period keep the order of the file.
            part = folder / f"{len(parts):04d}-{number:05d}-{period[1]}.arrow"
            rows.write_ipc(part, compression="lz4")
            parts.setdefault(period, []).append(part)
        # Checked at each block, before a damaged file fills the disk.
        if len(parts) > MAX_PERIODS:
            raise UserError(
                f"{source}, columns global_time and frame_id: they hold {len(parts)} recording "
                "periods or more; expected global_time in milliseconds and frame_id in steps of "
                "100 ms."
            )

    # Adjacent minutes are one period: a location's number grows where the minute before is empty.
    periods: dict[str, list[Path]] = {}
    numbers = Counter[str]()
    for location, minute in sorted(parts):
        if (location, minute - 1) not in parts:
            numbers[location] += 1
        name = f"{location}-{numbers[location]}"
        periods.setdefault(name, []).extend(parts[location, minute])

    for name, files in periods.items():
        location = name.rpartition("-")[0]
        if numbers[location] == 1 or len(files) > 1:
            continue
        # A few rows that make a period of their own have a wrong time or frame.
        rows = _read(files)
        if rows.height < MIN_ROWS:
            first = rows.sort(LINE).row(0, named=True)
            raise UserError(
                f"{source}, line {first[LINE]}, columns frame_id and global_time: frame "
                f"{first['frame_id']} at {first['global_time']} ms fits no recording period of "
                f"{location} ({rows.height} rows alone); correct or remove the row."
            )
    return periods


def _read(parts: list[Path]) -> pl.DataFrame:
    """The rows of a period, not sorted."""
    return pl.concat([pl.read_ipc(part) for part in parts])


def _scene(
    name: str,
    rows: pl.DataFrame,
    path: Path,
    lanes: int,
    count: RowCount,
) -> Scene | None:
    """The ``rows`` of one period in the schema; None where none of them is on a lane.

    Args:
        name: of the period.
        rows: in feet, in any order.
        path: the file that they were read from.
        lanes: NGSIM's number of the last lane that is kept.
        count: rows dropped are added to it.
    """
    source = f"{path}, {name}"
    rows = _drop_duplicates(rows, count)
    _check_order(rows, path)
    _check_units(rows, source)

    # Rows beyond the lanes that are kept end a track.
    count.drop("lane below 1", (rows["lane_id"] < 1).sum())
    count.drop("ramp", (rows["lane_id"] > lanes).sum())
    rows = rows.filter(rows["lane_id"].is_between(1, lanes))
    if rows.is_empty():
        return None

    # NGSIM counts lanes from the left, from 1.
    from_left = rows["lane_id"].to_numpy() - 1
    right_m = FOOT_M * rows["local_x"].to_numpy()
    # Every n-th row is enough to estimate the lanes, and bounds the memory; -(-a // b) is a / b
    # rounded up.
    every = -(-len(right_m) // ROWS_FOR_LANES)
    width, first_centre = lane_grid(right_m[::every], from_left[::every], source)
    # From the left the last one is the rightmost.
    last = int(from_left.max())

    # Front centres in feet become centres of the body in metres.
    frame = rows.select(
        scene=pl.lit(name),
        vehicle="vehicle_id",
        frame="frame_id",
        x=FOOT_M * (pl.col("local_y") - 0.5 * pl.col("v_length")),
        y=pl.Series(last * width - (right_m - first_centre)),
        speed=FOOT_M * pl.col("v_vel"),
        lane=pl.Series(last - from_left),
        length=FOOT_M * pl.col("v_length"),
        width=FOOT_M * pl.col("v_width"),
    )
    return Scene(name, sort(number_tracks(frame, str(path))), width)


def _drop_duplicates(rows: pl.DataFrame, count: RowCount) -> pl.DataFrame:
    """Rows by vehicle and time.

    Of several rows of one vehicle at one time the first in the file stays; equal and other ones are
    counted apart.
    """
    # The file's own order decides which of several rows is the first.
    rows = rows.sort("vehicle_id", "global_time", LINE)
    unequal = rows.unique(list(COLUMNS), keep="first", maintain_order=True)
    first = unequal.unique(["vehicle_id", "global_time"], keep="first", maintain_order=True)
    count.drop("duplicate", rows.height - unequal.height)
    count.drop("same vehicle and time, other values", unequal.height - first.height)
    return first


def _check_order(rows: pl.DataFrame, path: Path) -> None:
    """Frames must grow with time, and be 100 ms apart.

    Raises:
        UserError: at the first row for which that is not so.
    """
    steps = rows.select(pl.col("frame_id", "global_time").diff().over("vehicle_id"))
    what = "does not grow with global_time within its vehicle"
    raise_where(steps["frame_id"] <= 0, rows, "frame_id", path, what)

    apart = steps["global_time"] != FRAME_MS * steps["frame_id"]
    what = "is not 100 ms a frame after the row before"
    raise_where(apart, rows, "global_time", path, what)


def _check_units(rows: pl.DataFrame, source: str) -> None:
    """Lengths, positions and speeds must be in feet and seconds.

    Raises:
        UserError: they cannot be.
    """
    # Any line of the period will do: the unit is that of the whole column.
    line = int(rows[LINE].min())  # type: ignore[arg-type]
    length = float(rows["v_length"].median())  # type: ignore[arg-type]
    if not LENGTHS_FT[0] <= length <= LENGTHS_FT[1]:
        guess = "metres" if length < LENGTHS_FT[0] else "centimetres or inches"
        raise UserError(
            f"{source}, from line {line}, column v_length: the median is {length:.1f}, expected "
            f"feet, about 15; they look like {guess}, convert all columns to feet."
        )

    # The pace is distance over speed times time, 1 in consistent units.
    distance = pl.col("local_y").last() - pl.col("local_y").first()
    seconds = (pl.col("global_time").last() - pl.col("global_time").first()) / 1000.0
    speed = pl.col("v_vel").mean()
    per_vehicle = rows.group_by("vehicle_id", maintain_order=True).agg(
        pace=distance / (seconds * speed),
        rows=pl.len(),
        speed=speed,
    )
    is_long = pl.col("rows") >= _PACE_FRAMES
    is_moving = pl.col("speed") >= _PACE_FT_S
    # None where nobody moves.
    pace = per_vehicle.filter(is_long & is_moving)["pace"].median()
    if isinstance(pace, float) and not PACE[0] <= pace <= PACE[1]:
        raise UserError(
            f"{source}, from line {line}, columns local_y and v_vel: vehicles cover {pace:.2f} "
            "times the distance that their speed makes; expected feet and feet per second (0.91 "
            "would be km/h, 1.47 miles per hour, 3.28 m/s), convert v_vel."
        )
