"""The common form of all recordings, and its validator.

A recording is a polars frame of tracks in SI units, one row per vehicle and frame (:data:`SCHEMA`),
sorted by scene, vehicle and frame. A car that leaves the recorded road and returns has several
tracks; their numbers differ by multiples of :data:`TRACK_STRIDE`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import SupportsInt

import polars as pl

from ganlane.data.tables import FIRST_LINE
from ganlane.errors import UserError

#: Time between two frames, s.
FRAME_S = 0.1
#: Numbers of a car's tracks differ by it.
TRACK_STRIDE = 10_000
#: Columns in order, with their types.
SCHEMA = pl.Schema(
    {
        "scene": pl.String(),  # one recording; scenes are independent of each other
        # number of the track in its scene; ``vehicle % TRACK_STRIDE`` is the car
        "vehicle": pl.Int64(),
        "frame": pl.Int64(),  # frame number; frames are 0.1 s apart
        # centre of the body along the road, m, growing in the direction of travel
        "x": pl.Float64(),
        # centre of the body across the road, m, positive to the left; 0 at lane 0's centre
        "y": pl.Float64(),
        "speed": pl.Float64(),  # m/s, as recorded
        # as recorded; 0 is the scene's rightmost, its centre is at ``lane * lane_width``
        "lane": pl.Int64(),
        "length": pl.Float64(),  # m
        "width": pl.Float64(),  # m
    }
)
#: Columns that identify a track.
TRACK = ("scene", "vehicle")
#: Bounds that no recording of road traffic in SI units exceeds.
MAX_MEDIAN_SPEED_MPS = 60.0
MAX_MEDIAN_LENGTH_M = 12.0
#: Between the speeds recorded and those that positions show, either way.
MAX_SPEED_RATIO = 1.4
#: A track that ends so far behind its beginning runs backwards, m.
BACKWARDS_M = 5.0


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
    """Rows read from files, before any interpolation, and those dropped, by reason."""

    read: int = 0
    dropped: Counter[str] = field(default_factory=Counter)

    @property
    def kept(self) -> int:
        """Rows read and not dropped."""
        return self.read - self.dropped.total()

    def drop(self, reason: str, rows: SupportsInt) -> None:
        """Count ``rows`` dropped for ``reason``."""
        if int(rows):
            self.dropped[reason] += int(rows)


def sort(frame: pl.DataFrame) -> pl.DataFrame:
    """Rows sorted by scene, vehicle and frame."""
    return frame.sort("scene", "vehicle", "frame")


def number_tracks(frame: pl.DataFrame, source: str) -> pl.DataFrame:
    """Split each car's rows into tracks without a missing frame.

    ``frame`` is one scene, sorted by ``vehicle`` and ``frame``. A car's second track is numbered
    ``vehicle + TRACK_STRIDE``, its third ``vehicle + 2 TRACK_STRIDE``.

    Raises:
        UserError: a vehicle number is negative or not below :data:`TRACK_STRIDE`.
    """
    # Numbers at or above the stride would look like later tracks.
    low, high = frame.select(
        low=pl.col("vehicle").min(),
        high=pl.col("vehicle").max(),
    ).row(0)
    if low < 0 or high >= TRACK_STRIDE:
        raise UserError(
            f"{source}: vehicle numbers from {low} to {high}; expected 0 to {TRACK_STRIDE - 1}, "
            "number them anew."
        )

    # A new track begins after each missing frame of the same car.
    has_gap = pl.col("frame").diff() != 1
    same_car = pl.col("vehicle").diff() == 0
    begins = (has_gap & same_car).fill_null(False)
    # Gaps so far: 0 in a car's first track.
    track = begins.cast(pl.Int64).cum_sum().over("vehicle")
    return frame.with_columns(vehicle=pl.col("vehicle") + TRACK_STRIDE * track)


def validate(
    frame: pl.DataFrame,
    source: str,
    first_line: int | None = FIRST_LINE,
) -> pl.DataFrame:
    """Check a frame against the schema and return its columns in order; rows are unchanged.

    Args:
        frame: rows in the order of the file they come from.
        source: name of the file, for messages.
        first_line: line of the file that holds the first row; None where rows are not lines (they
            count from 0).

    Raises:
        UserError: a missing column, no rows, NaN or null, a frame number that does not grow within
            its track, a track that runs backwards, a size of 0 or less, or units that cannot be
            metres and metres per second.
    """
    # Columns beyond the schema are ignored.
    missing = [name for name in SCHEMA if name not in frame.columns]
    if missing:
        raise UserError(f"{source}: no column {', '.join(missing)}; expected {', '.join(SCHEMA)}.")
    if frame.is_empty():
        raise UserError(f"{source}: no rows; a recording with at least one vehicle was expected.")

    for name, kind in SCHEMA.items():
        try:
            frame = frame.with_columns(pl.col(name).cast(kind))
        except pl.exceptions.PolarsError as error:
            raise UserError(
                f"{source}, column {name}: {frame[name].dtype} found, {kind} expected."
            ) from error
    frame = frame.select(SCHEMA.names())
    # The first mistake is raised.
    for row, what in _mistakes(frame):
        line = f"row {row}" if first_line is None else f"line {row + first_line}"
        raise UserError(f"{source}, {line}, {what}.")
    return frame


def _mistakes(frame: pl.DataFrame) -> Iterator[tuple[int, str]]:
    """What is wrong with a frame of the schema's columns: the row, and a part of a sentence.

    From the plainest damage to what single rows do not show. Later mistakes may come of earlier
    ones, so only the first one counts.
    """
    frame = frame.with_columns(step=pl.col("frame").diff().over(TRACK))
    step = pl.col("step")

    def first(bad: pl.Expr) -> Iterator[int]:
        """The first row that is ``bad``, if there is one."""
        yield from frame.select(bad.arg_true().first()).to_series().drop_nulls()

    # Column, what is wrong with it, and in which rows.
    bad: list[tuple[str, str, pl.Expr]] = []
    for name, kind in SCHEMA.items():
        if kind == pl.Float64():
            is_number = pl.col(name).is_finite().fill_null(False)
            bad.append((name, "is not a finite number", ~is_number))
        else:
            bad.append((name, "is missing", pl.col(name).is_null()))
    for name in ("length", "width"):
        bad.append((name, "is not above 0", pl.col(name) <= 0.0))
    bad.append(("frame", "comes twice in its track", step == 0))
    bad.append(("frame", "is before its track's last frame; frames must grow", step < 0))
    for column, what, is_bad in bad:
        for row in first(is_bad):
            yield row, f"column {column}: {frame[column][row]} {what}"

    # With most rows further apart than a frame, nothing could be measured between them.
    most_apart = step.median().over("scene") > 1
    for row in first(most_apart & (step > 1)):
        yield (
            row,
            f"column frame: most rows of scene {frame['scene'][row]} come {frame['step'][row]} "
            f"frames after their track's last one; expected {1 / FRAME_S:.0f} frames a second, "
            "numbered one by one: resample the recording",
        )

    # Noise moves a standing car back by decimetres; further back a whole track is turned round.
    track_m = (pl.col("x").last() - pl.col("x").first()).over(TRACK)
    for row in first(track_m < -BACKWARDS_M):
        yield (
            row,
            "column x: its track runs backwards, against the direction of growing x; turn x and y "
            "of that carriageway round, or leave its tracks out",
        )

    # Distance per time, m/s, from one row to the next of a track.
    rates = pl.col("x").diff().over(TRACK) / (step * FRAME_S)
    # Medians, which a few damaged rows do not move.
    speed, length, rate = frame.select(
        pl.col("speed", "length").median(),
        rate=rates.median(),
    ).row(0)
    bounds = (
        ("speed", speed, MAX_MEDIAN_SPEED_MPS, "m/s; convert to m/s"),
        ("length", length, MAX_MEDIAN_LENGTH_M, "m; convert feet to m"),
    )
    for column, median, bound, unit in bounds:
        if median > bound:
            row = next(first(pl.col(column) > bound))
            yield row, f"column {column}: the median is {median:.1f}, which cannot be {unit}"

    # Standing traffic shows no ratio. Not even rounded positions give another one than about 1.
    moves = rate is not None and max(abs(rate), abs(speed)) >= 1.0
    if moves and not speed / MAX_SPEED_RATIO < rate < speed * MAX_SPEED_RATIO:
        low = pl.col("speed") / MAX_SPEED_RATIO
        high = pl.col("speed") * MAX_SPEED_RATIO
        yield (
            next(first(~rates.is_between(low, high)), 0),
            f"columns x and speed: x moves by {rate:.1f} m per second where speed says "
            f"{speed:.1f} m/s; expected metres along the direction of travel, m/s and "
            f"{1 / FRAME_S:.0f} frames a second",
        )
