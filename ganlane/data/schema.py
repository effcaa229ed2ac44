"""The common form of all recordings: a polars frame of tracks, in SI units, one row per vehicle and frame.

===========  =======  ==============================================================================
``scene``    String   one recording; scenes are independent of each other
``vehicle``  Int64    number of the track in its scene; ``vehicle % TRACK_STRIDE`` is the car (see below)
``frame``    Int64    frame number; frames are 0.1 s apart
``x``        Float64  centre of the body along the road, m, growing in the direction of travel
``y``        Float64  centre of the body across the road, m, positive to the left; 0 at the centre of lane 0
``speed``    Float64  m/s, as recorded
``lane``     Int64    as recorded; 0 is the scene's rightmost, and the centre is at ``lane * lane_width``
``length``   Float64  m
``width``    Float64  m
===========  =======  ==============================================================================

A car that leaves the recorded road and returns has several tracks; their numbers differ by multiples of
:data:`TRACK_STRIDE`. Rows are sorted by scene, vehicle and frame.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
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
#: Columns that identify a track.
TRACK: Final = ("scene", "vehicle")

#: Bounds that no recording of road traffic in SI units exceeds.
MAX_MEDIAN_SPEED_MPS: Final = 60.0
MAX_MEDIAN_LENGTH_M: Final = 12.0
MAX_SPEED_RATIO: Final = 1.4


@dataclass(frozen=True)
class Scene:
    """One recording in the schema, sorted, with the width of its lanes in metres."""

    name: str
    frame: pl.DataFrame
    lane_width_m: float

    @property
    def lanes(self) -> int:
        """Number of lanes: the highest lane number plus one."""
        return int(self.frame["lane"].max()) + 1  # type: ignore[arg-type]


@dataclass
class RowCount:
    """Number of rows read from files, before any interpolation, and how many were dropped for which reason."""

    read: int = 0
    dropped: Counter[str] = field(default_factory=Counter)

    @property
    def kept(self) -> int:
        """Rows read and not dropped."""
        return self.read - self.dropped.total()

    def drop(self, reason: str, rows: int) -> None:
        """Count ``rows`` dropped for ``reason``."""
        if rows:
            self.dropped[reason] += int(rows)


def sort(frame: pl.DataFrame) -> pl.DataFrame:
    """Rows sorted by scene, vehicle and frame."""
    return frame.sort("scene", "vehicle", "frame")


def number_tracks(frame: pl.DataFrame, source: str) -> pl.DataFrame:
    """Split each car's rows into tracks without a missing frame; one scene, sorted by ``vehicle`` and ``frame``.

    A car's second track is numbered ``vehicle + TRACK_STRIDE``, its third ``vehicle + 2 TRACK_STRIDE``.

    Raises:
        UserError: a vehicle number is negative or not below :data:`TRACK_STRIDE`.
    """
    low, high = (int(end) for end in frame.select(low=pl.col("vehicle").min(), high=pl.col("vehicle").max()).row(0))
    if low < 0 or high >= TRACK_STRIDE:
        raise UserError(
            f"{source}: vehicle numbers from {low} to {high}; expected 0 to {TRACK_STRIDE - 1}, number them anew."
        )
    gap = (pl.col("frame").diff() != 1) & (pl.col("vehicle").diff() == 0)
    track = gap.fill_null(False).cast(pl.Int64).cum_sum().over("vehicle")
    return frame.with_columns(vehicle=pl.col("vehicle") + TRACK_STRIDE * track)


def validate(frame: pl.DataFrame, source: str, first_line: int | None = FIRST_LINE) -> pl.DataFrame:
    """Check a frame against the schema and return its columns in order; rows are unchanged.

    Args:
        frame: rows in the order of the file they come from.
        source: name of the file, for messages.
        first_line: line of the file that holds the first row; None where rows are not lines (they count from 0).

    Raises:
        UserError: a missing column, no rows, NaN or null, a frame number that does not grow within its track, a size
            of 0 or less, or units that cannot be metres and metres per second.
    """
    missing = [name for name in SCHEMA if name not in frame.columns]
    if missing:
        raise UserError(f"{source}: no column {', '.join(missing)}; expected {', '.join(SCHEMA)}.")
    if frame.is_empty():
        raise UserError(f"{source}: no rows; a recording with at least one vehicle was expected.")
    for name, kind in SCHEMA.items():
        try:
            frame = frame.with_columns(frame[name].cast(kind))
        except pl.exceptions.PolarsError as error:
            raise UserError(f"{source}, column {name}: {frame[name].dtype} found, {kind} expected.") from error
    frame = frame.select(SCHEMA.names())
    _check_rows(frame, source, first_line)
    _check_units(frame, source, first_line)
    return frame


def _place(source: str, row: int, first_line: int | None) -> str:
    return f"{source}, row {row}" if first_line is None else f"{source}, line {row + first_line}"


def _check_rows(frame: pl.DataFrame, source: str, first_line: int | None) -> None:
    """Errors that one row, or one row and its predecessor in the track, are enough to show."""
    step = pl.col("frame").diff().over(TRACK)
    errors: list[tuple[str, str, pl.Expr]] = [
        *((name, "is not a finite number", ~pl.col(name).is_finite()) for name in ("x", "y", "speed")),
        *((name, "is missing", pl.col(name).is_null()) for name in ("scene", "vehicle", "frame", "lane")),
        *((name, "is not above 0", ~(pl.col(name) > 0.0)) for name in ("length", "width")),
    ]
    # Null counts as an error in these, while the first frame of a track has no step.
    errors = [(name, what, bad.fill_null(True)) for name, what, bad in errors]
    errors += [
        ("frame", "comes twice in its track", (step == 0).fill_null(False)),
        ("frame", "is before its track's last frame; frames must grow", (step < 0).fill_null(False)),
    ]
    for column, what, bad in errors:
        rows = frame.select(bad.arg_true()).to_series()
        if len(rows):
            value = frame[column][rows[0]]
            raise UserError(f"{_place(source, rows[0], first_line)}, column {column}: {value} {what}.")


def _check_units(frame: pl.DataFrame, source: str, first_line: int | None) -> None:
    """Frames, positions, speeds or sizes that cannot be in 0.1 s and metres; the first row that shows it is named."""
    # With most rows further apart than a frame, nothing could be measured between them.
    steps = frame.select("scene", step=pl.col("frame").diff().over(TRACK)).with_row_index("row")
    far = steps.filter((pl.col("step").median().over("scene") > 1) & (pl.col("step") > 1)).head(1)
    if not far.is_empty():
        row, scene, step = far.row(0)
        raise UserError(
            f"{_place(source, row, first_line)}, column frame: most rows of scene {scene} come {step} frames after "
            f"their track's last one; expected {1 / FRAME_S:.0f} frames a second, numbered one by one: resample the "
            "recording."
        )
    rates = pl.col("x").diff().over(TRACK) / (pl.col("frame").diff().over(TRACK) * FRAME_S)
    speed, length, rate = frame.select(pl.col("speed", "length").median(), rate=rates.median()).row(0)
    for column, median, bound, unit in (
        ("speed", speed, MAX_MEDIAN_SPEED_MPS, "m/s; convert to m/s"),
        ("length", length, MAX_MEDIAN_LENGTH_M, "m; convert feet to m"),
    ):
        if median > bound:
            place = _place(source, int((frame[column] > bound).arg_max() or 0), first_line)
            raise UserError(f"{place}, column {column}: the median is {median:.1f}, which cannot be {unit}.")
    if rate is None or max(abs(rate), abs(speed)) < 1.0:
        return
    if not speed / MAX_SPEED_RATIO < rate < speed * MAX_SPEED_RATIO:
        agrees = rates.is_between(pl.col("speed") / MAX_SPEED_RATIO, pl.col("speed") * MAX_SPEED_RATIO)
        row = frame.select((~agrees).fill_null(False).arg_true().first()).item()
        raise UserError(
            f"{_place(source, int(row or 0), first_line)}, columns x and speed: x moves by {rate:.1f} m per "
            f"second where speed says {speed:.1f} m/s; expected metres along the direction of travel, m/s and "
            f"{1 / FRAME_S:.0f} frames a second."
        )
