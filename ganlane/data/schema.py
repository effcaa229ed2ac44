"""The one form that every recording takes: a polars frame of tracks, in SI units, one row per vehicle and frame.

===========  =======  ==============================================================================
``scene``    String   one recording; frames of different scenes have nothing to do with each other
``vehicle``  Int64    a track of its scene; ``vehicle % TRACK_STRIDE`` is the car (see below)
``frame``    Int64    a frame lasts 0.1 s
``x``        Float64  centre of the body along the road, m, growing in the direction of travel
``y``        Float64  centre of the body across the road, m, to the left; 0 at the centre of lane 0
``speed``    Float64  m/s, as recorded
``lane``     Int64    as recorded; 0 is the scene's rightmost, and the centre is at ``lane * lane_width``
``length``   Float64  m
``width``    Float64  m
===========  =======  ==============================================================================

A car that leaves the picture and comes back has several tracks; their numbers differ by multiples of
:data:`TRACK_STRIDE`. Rows are sorted by scene, vehicle and frame.
"""

from __future__ import annotations

from typing import Final

import polars as pl

from ganlane.data.tables import FIRST_LINE
from ganlane.errors import UserError

FRAME_S: Final = 0.1
TRACK_STRIDE: Final = 10_000
#: Columns in order, with their types.
SCHEMA: Final = pl.Schema(
    {
        "scene": pl.String(),
        "vehicle": pl.Int64(),
        "frame": pl.Int64(),
        "x": pl.Float64(),
        "y": pl.Float64(),
        "speed": pl.Float64(),
        "lane": pl.Int64(),
        "length": pl.Float64(),
        "width": pl.Float64(),
    }
)
TRACK: Final = ("scene", "vehicle")

#: Bounds that no recording of road traffic in SI units passes.
MAX_MEDIAN_SPEED_MPS: Final = 60.0
MAX_MEDIAN_LENGTH_M: Final = 12.0
MAX_SPEED_RATIO: Final = 2.0


def validate(frame: pl.DataFrame, source: str, first_line: int | None = FIRST_LINE) -> pl.DataFrame:
    """Check a frame against the schema and return its columns in order, rows as they are.

    Args:
        frame: rows in the order of the file they come from.
        source: name of the file, for messages.
        first_line: line of the file that the first row stands on; None where rows are no lines of a file, and are
            then counted from 0.

    Raises:
        UserError: a missing column, no rows, NaN or null, a frame number that does not grow within its track,
            a size of 0 or less, or units that cannot be metres and metres per second; the message names
            ``source``, line and column.
    """
    missing = [name for name in SCHEMA if name not in frame.columns]
    if missing:
        raise UserError(f"{source}: no column {', '.join(missing)}; expected {', '.join(SCHEMA)}.")
    if frame.is_empty():
        raise UserError(f"{source}: no rows; a recording with at least one vehicle was expected.")
    frame = frame.select(_typed(frame[name], kind, source) for name, kind in SCHEMA.items())
    _check_rows(frame, source, first_line)
    _check_units(frame, source, first_line)
    return frame


def sort(frame: pl.DataFrame) -> pl.DataFrame:
    """Rows sorted by scene, vehicle and frame."""
    return frame.sort("scene", "vehicle", "frame")


def _typed(column: pl.Series, kind: pl.DataType, source: str) -> pl.Series:
    try:
        return column.cast(kind)
    except pl.exceptions.PolarsError as error:
        raise UserError(f"{source}, column {column.name}: {column.dtype} found, {kind} expected.") from error


def _place(row: int, first_line: int | None) -> str:
    return f"row {row}" if first_line is None else f"line {row + first_line}"


def _check_rows(frame: pl.DataFrame, source: str, first_line: int | None) -> None:
    """Report the first row with a fault that shows in the row itself or in its track."""
    step = pl.col("frame").diff().over(TRACK)
    finite = {name: pl.col(name).is_null() | ~pl.col(name).is_finite() for name in ("x", "y", "speed")}
    faults: list[tuple[str, str, pl.Expr]] = [
        *((name, "is not a finite number", bad) for name, bad in finite.items()),
        *((name, "is missing", pl.col(name).is_null()) for name in ("scene", "vehicle", "frame", "lane")),
        *(
            (name, "is not above 0", ~(pl.col(name).fill_null(0.0) > 0.0).fill_null(False))
            for name in ("length", "width")
        ),
        ("frame", "comes twice in its track", step == 0),
        ("frame", "is before its track's last frame; frames must grow", step < 0),
    ]
    for column, what, bad in faults:
        rows = frame.select(bad.fill_null(False).arg_true()).to_series()
        if len(rows):
            value = frame[column][rows[0]]
            raise UserError(f"{source}, {_place(rows[0], first_line)}, column {column}: {value} {what}.")


def _check_units(frame: pl.DataFrame, source: str, first_line: int | None) -> None:
    """Report positions, speeds or sizes that cannot be in metres and seconds, and the first row that shows it."""
    paces = pl.col("x").diff().over(TRACK) / (pl.col("frame").diff().over(TRACK) * FRAME_S)
    medians = frame.select(pl.col("speed", "length").median(), pace=paces.median())
    speed, length, moved = medians.row(0)
    for column, median, bound, unit in (
        ("speed", speed, MAX_MEDIAN_SPEED_MPS, "m/s; convert to m/s"),
        ("length", length, MAX_MEDIAN_LENGTH_M, "m; convert feet to m"),
    ):
        if median > bound:
            place = _place(int((frame[column] > bound).arg_max() or 0), first_line)
            raise UserError(
                f"{source}, {place}, column {column}: the median is {median:.1f}, which cannot be {unit}."
            )
    if moved is None or max(abs(moved), abs(speed)) < 1.0:
        return
    if not speed / MAX_SPEED_RATIO < moved < speed * MAX_SPEED_RATIO:
        agrees = paces.is_between(pl.col("speed") / MAX_SPEED_RATIO, pl.col("speed") * MAX_SPEED_RATIO)
        row = frame.select((~agrees).fill_null(False).arg_true().first()).item()
        raise UserError(
            f"{source}, {_place(int(row or 0), first_line)}, columns x and speed: x moves by {moved:.1f} m per "
            f"second where speed says {speed:.1f} m/s; expected metres along the direction of travel, m/s and "
            f"{1 / FRAME_S:.0f} frames a second."
        )
