"""highD recordings (Krajewski et al. 2018): three files each, 25 Hz, two directions of travel, into
the schema.

Each direction becomes a scene of its own, in its drivers' view: ``x`` forward, ``y`` to the left,
lane 0 rightmost. highD's images have ``y`` downwards and call the length of a vehicle its
``width``; ``x, y`` are the upper left corner of its bounding box. Vehicles of the upper lanes
(direction 1) drive to the left in the image, those of the lower lanes (direction 2) to the right.
Positions and speeds are interpolated linearly to 10 Hz; the lane is that of the nearest recorded
frame. Positions are not smoothed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import polars as pl

from ganlane.data.lanes import Flags, Floats, Integers
from ganlane.data.schema import (
    FRAME_S,
    SCHEMA,
    RowCount,
    Scene,
    number_tracks,
    raise_where,
    read_table,
    sort,
    validate,
)
from ganlane.errors import UserError

_TRACKS: Final = "_tracks.csv"
#: Columns of ``XX_tracks.csv`` that are read.
COLUMNS: Final = {
    **dict.fromkeys(("frame", "id", "laneid"), pl.Int64),
    **dict.fromkeys(("x", "y", "width", "height", "xvelocity"), pl.Float64),
}
#: ``drivingDirection`` of the upper lanes, driven to the left in the image, and of the lower lanes.
UPPER: Final = 1
LOWER: Final = 2


@dataclass(frozen=True)
class _Direction:
    """One direction of travel.

    ``lane_ids`` from the rightmost, ``right_edge`` is the image's ``y`` in m.
    """

    number: int
    lane_ids: tuple[int, ...]
    right_edge: float
    lane_width: float


def highd_scenes(path: str | Path, count: RowCount | None = None) -> Iterator[Scene]:
    """Two scenes, ``highd-XX-upper`` and ``highd-XX-lower``, for each recording.

    ``path`` is an ``XX_tracks.csv`` next to its ``XX_tracksMeta.csv`` and ``XX_recordingMeta.csv``,
    or a folder of them; rows read and dropped are added to ``count``.

    Raises:
        UserError: a missing or damaged file; the message names file, line and column.
    """
    path, count = Path(path), count if count is not None else RowCount()
    if path.is_dir():
        recordings = sorted(path.glob(f"*{_TRACKS}"))
        if not recordings:
            raise UserError(
                f"{path}: no XX{_TRACKS} in this folder; give highD's data folder or one such file."
            )
    elif not path.name.endswith(_TRACKS):
        raise UserError(f"{path}: expected highD's XX{_TRACKS} or a folder of recordings.")
    else:
        recordings = [path]
    for tracks in recordings:
        stem = tracks.name.removesuffix(_TRACKS)
        rate_hz, directions = _read_recording_meta(tracks.with_name(f"{stem}_recordingMeta.csv"))
        rows = _read_rows(tracks, tracks.with_name(f"{stem}_tracksMeta.csv"), count)
        for direction in directions:
            name = f"highd-{stem}-{'upper' if direction.number == UPPER else 'lower'}"
            if scene := _scene(rows, direction, rate_hz, name, tracks, count):
                yield scene


def _read_recording_meta(path: Path) -> tuple[float, tuple[_Direction, _Direction]]:
    """Frame rate in Hz, and both directions. Lane ids grow downwards.

    The id between the directions is unused.
    """
    columns = {
        "framerate": pl.Float64,
        "upperlanemarkings": pl.String,
        "lowerlanemarkings": pl.String,
    }
    rate_hz, *markings = read_table(path, columns).select(columns.keys()).row(0)
    if rate_hz < 10.0:
        raise UserError(f"{path}, line 2, column framerate: {rate_hz}, expected 10 Hz or more.")
    upper, lower = (_markings(text, path, name) for text, name in zip(markings, list(columns)[1:]))
    n_upper, n_lower = len(upper) - 1, len(lower) - 1
    upper_ids = tuple(range(2, 2 + n_upper))
    lower_ids = tuple(range(n_upper + 2 + n_lower, n_upper + 2, -1))
    return rate_hz, (
        _Direction(UPPER, upper_ids, upper[0], (upper[-1] - upper[0]) / n_upper),
        _Direction(LOWER, lower_ids, lower[-1], (lower[-1] - lower[0]) / n_lower),
    )


def _markings(text: str, path: Path, column: str) -> tuple[float, ...]:
    """``y`` of the lane markings in the image, m: ``8.51;12.59;16.43`` as numbers."""
    try:
        found = tuple(float(part) for part in text.split(";") if part.strip())
    except ValueError:
        found = ()
    if len(found) < 2 or any(b <= a for a, b in pairwise(found)):
        raise UserError(
            f"{path}, line 2, column {column}: {text!r}; expected two or more growing numbers separated by ;"
        )
    return found


def _read_rows(path: Path, meta: Path, count: RowCount) -> pl.DataFrame:
    """Rows of a recording, sorted by vehicle and frame.

    ``direction`` is its vehicle's in the ``meta`` file.
    """
    cars = read_table(meta, {"id": pl.Int64, "drivingdirection": pl.Int64})
    direction = cars["drivingdirection"]
    what = "is neither 1 (upper lanes) nor 2 (lower lanes)"
    raise_where(~direction.is_in([UPPER, LOWER]), cars, "drivingdirection", meta, what)
    rows = read_table(path, COLUMNS)
    count.read += rows.height
    for name in ("width", "height"):
        raise_where(rows[name] <= 0.0, rows, name, path, "is not above 0")
    step = rows.select(pl.col("frame").diff().over("id")).to_series()
    raise_where(
        step <= 0,
        rows,
        "frame",
        path,
        "is not after the last frame of its vehicle; frames must grow",
    )
    directions = rows["id"].replace_strict(
        cars["id"], direction, default=None, return_dtype=pl.Int64
    )
    raise_where(directions.is_null(), rows, "id", path, "is not in the tracksMeta file")
    return rows.with_columns(directions.alias("direction")).sort("id", "frame")


def _scene(
    rows: pl.DataFrame,
    direction: _Direction,
    rate_hz: float,
    name: str,
    path: Path,
    count: RowCount,
) -> Scene | None:
    """One direction in the schema, with a frame every 0.1 s; None where it has no vehicles."""
    rows = rows.filter(pl.col("direction") == direction.number)
    on_road = rows["laneid"].is_in(list(direction.lane_ids))
    count.drop("off the lanes of its direction", (~on_road).sum())
    rows = rows.filter(on_road)
    if rows.is_empty():
        return None
    forward = -1.0 if direction.number == UPPER else 1.0
    along = forward * (pl.col("x") + 0.5 * pl.col("width"))
    # Upper lanes: left is down in the image, where y grows; lower lanes: left is up.
    left = -forward * (pl.col("y") + 0.5 * pl.col("height") - direction.right_edge)
    numbers = {lane_id: lane for lane, lane_id in enumerate(direction.lane_ids)}
    turned = rows.select(
        pl.lit(name).alias("scene"),
        pl.col("id").alias("vehicle"),
        "frame",
        x=along - along.min(),
        y=left - 0.5 * direction.lane_width,
        speed=forward * pl.col("xvelocity"),
        lane=pl.col("laneid").replace_strict(numbers, return_dtype=pl.Int64),
        length="width",
        width="height",
    )
    tracks = number_tracks(turned, str(path))
    begins = (tracks["vehicle"].diff() != 0).fill_null(True).to_numpy()
    old = {name: tracks[name].to_numpy() for name in SCHEMA}
    new = resample(begins, old["frame"], rate_hz)
    nearest = np.where(new.share > 0.5, new.after, new.before)
    columns = {
        "scene": old["scene"][new.before],
        "vehicle": old["vehicle"][new.before],
        "frame": new.frame,
    }
    columns |= {name: new.linear(old[name]) for name in ("x", "y", "speed", "length", "width")}
    frame = pl.DataFrame(columns | {"lane": old["lane"][nearest]}, schema_overrides=SCHEMA).select(
        SCHEMA.names()
    )
    if frame.is_empty():
        return None
    return Scene(
        name, sort(validate(frame, f"{path}, {name}", first_line=None)), direction.lane_width
    )


class Resampling(NamedTuple):
    """R new samples among the old ones.

    Attributes:
        frame: [R] new frame numbers, 0.1 s each; frame 0 is the old frame 0.
        before, after: [R] indices of the old samples around each; equal at the end of a track.
        share: [R] position between the two, 0 to below 1.
    """

    frame: Integers
    before: Integers
    after: Integers
    share: Floats

    def linear(self, values: Floats) -> Floats:
        """[R] values, interpolated linearly."""
        return values[self.before] + self.share * (values[self.after] - values[self.before])


def resample(begins: Flags, frame: Integers, rate_hz: float) -> Resampling:
    """Samples every 0.1 s within each track, none beyond its ends.

    ``begins`` [S] is true at the first old sample of each track; within a track ``frame`` [S] grows
    by one.
    """
    starts = np.flatnonzero(begins)
    ends = np.append(starts[1:], len(frame)) - 1
    per_step = rate_hz * FRAME_S
    # A small tolerance, so that a new frame at the time of an old one is kept in spite of rounding.
    first = np.ceil(frame[starts] / per_step - 1e-9).astype(np.int64)
    last = np.floor(frame[ends] / per_step + 1e-9).astype(np.int64)
    samples = np.maximum(last - first + 1, 0)
    track = np.repeat(np.arange(len(starts)), samples)
    offset = np.arange(len(track)) - np.repeat(np.cumsum(samples) - samples, samples)
    new = first[track] + offset
    place = new * per_step - frame[starts][track]
    whole = np.floor(place + 1e-9)
    before = starts[track] + whole.astype(np.int64)
    return Resampling(
        new, before, np.minimum(before + 1, ends[track]), np.clip(place - whole, 0.0, 1.0)
    )
