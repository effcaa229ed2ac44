"""highD recordings (Krajewski et al. 2018): three files each, at 25 Hz, both directions of travel.

Each direction becomes a scene of its own, in its drivers' view: ``x`` forward, ``y`` to the left,
lane 0 rightmost. highD's images have ``y`` downwards and call the length of a vehicle its
``width``; ``x, y`` are the upper left corner of its bounding box. Vehicles of the upper lanes
(direction 1) drive to the left in the image, those of the lower lanes (direction 2) to the right.
Positions and speeds are interpolated linearly to 10 Hz; the lane is that of the nearest recorded
frame. Positions are not smoothed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from ganlane.data.schema import (
    FRAME_S,
    RowCount,
    Scene,
    number_tracks,
    sort,
    validate,
)
from ganlane.data.tables import LINE, raise_unless_positive, raise_where, read_table
from ganlane.errors import UserError

#: How the name of a file of tracks ends, after the recording's number.
_TRACKS = "_tracks.csv"
#: Columns of ``XX_tracks.csv`` that are read.
COLUMNS = {
    **dict.fromkeys(("frame", "id", "laneid"), pl.Int64),
    **dict.fromkeys(("x", "y", "width", "height", "xvelocity"), pl.Float64),
}
#: Columns of ``XX_recordingMeta.csv`` that are read.
_META = {
    "framerate": pl.Float64,
    "upperlanemarkings": pl.String,
    "lowerlanemarkings": pl.String,
}
#: Each direction's side of the image, its ``drivingDirection``, and whether ``x`` of the image
#: grows (1) or falls (-1) along it.
_SIDES = (
    ("upper", 1, -1.0),
    ("lower", 2, 1.0),
)


@dataclass(frozen=True)
class _Direction:
    """One direction of travel.

    Attributes:
        side, number, forward: those of :data:`_SIDES`.
        lane_ids: of its lanes, from the rightmost.
        right_edge: ``y`` of the image at the road's right edge, seen by its drivers, m.
        lane_width: mean over its lanes, m.
    """

    side: str
    number: int
    forward: float
    lane_ids: Sequence[int]
    right_edge: float
    lane_width: float


def highd_scenes(path: str | Path, count: RowCount) -> Iterator[Scene]:
    """Two scenes, ``highd-XX-upper`` and ``highd-XX-lower``, for each recording.

    Args:
        path: an ``XX_tracks.csv`` next to its ``XX_tracksMeta.csv`` and ``XX_recordingMeta.csv``,
            or a folder of them.
        count: rows read and dropped are added to it.

    Raises:
        UserError: a missing or damaged file; the message names file, line and column.
    """
    path = Path(path)
    # A folder holds up to 60 recordings; one file is one of them.
    recordings = sorted(path.glob(f"*{_TRACKS}")) if path.is_dir() else [path]
    if not recordings:
        raise UserError(
            f"{path}: no XX{_TRACKS} in this folder; give highD's data folder or one such file."
        )
    for tracks in recordings:
        if not tracks.name.endswith(_TRACKS):
            raise UserError(f"{path}: expected highD's XX{_TRACKS} or a folder of recordings.")
        stem = tracks.name.removesuffix(_TRACKS)
        recording_meta = tracks.with_name(f"{stem}_recordingMeta.csv")
        tracks_meta = tracks.with_name(f"{stem}_tracksMeta.csv")

        rate_hz, directions = _read_recording_meta(recording_meta)
        # Both directions are in one file.
        rows = _read_rows(tracks, tracks_meta, count)
        for direction in directions:
            name = f"highd-{stem}-{direction.side}"
            scene = _scene(rows, direction, rate_hz, name, tracks, count)
            if scene is not None:
                yield scene


def _read_recording_meta(path: Path) -> tuple[float, list[_Direction]]:
    """Frame rate in Hz, and both directions.

    Lane ids grow downwards from 2; the id between the directions is unused.
    """
    meta = read_table(path, _META).row(0, named=True)
    rate_hz = meta["framerate"]
    # Frames are dropped or interpolated, never invented.
    if rate_hz < 10.0:
        raise UserError(f"{path}, line 2, column framerate: {rate_hz}, expected 10 Hz or more.")

    directions = []
    first_id = 2
    for side, number, forward in _SIDES:
        column = f"{side}lanemarkings"
        # From the top of the image downwards.
        edges = _markings(meta[column], path, column)
        lanes = len(edges) - 1
        ids = range(first_id, first_id + lanes)
        # The rightmost of the upper lanes, seen by its drivers, is at the top of the image; that of
        # the lower lanes is at the bottom.
        from_right = slice(None, None, -int(forward))
        directions.append(
            _Direction(
                side,
                number,
                forward,
                lane_ids=ids[from_right],
                right_edge=edges[from_right][0],
                lane_width=(edges[-1] - edges[0]) / lanes,
            )
        )
        # One id more: that between the directions.
        first_id += lanes + 1
    return rate_hz, directions


def _markings(text: str, path: Path, column: str) -> list[float]:
    """``y`` of the lane markings in the image, m: ``8.51;12.59;16.43`` as numbers.

    Raises:
        UserError: they are no growing numbers; it names the ``column`` of the file ``path``.
    """
    try:
        markings = [float(part) for part in text.split(";") if part.strip()]
    except ValueError:
        # Refused below, as too few are.
        markings = []
    if len(markings) < 2 or not (np.diff(markings) > 0.0).all():
        raise UserError(
            f"{path}, line 2, column {column}: {text!r}; expected two or more growing numbers "
            "separated by ;"
        )
    return markings


def _read_rows(path: Path, meta: Path, count: RowCount) -> pl.DataFrame:
    """Rows of a recording, sorted by vehicle and frame.

    ``drivingdirection`` is its vehicle's in the ``meta`` file.
    """
    cars = read_table(meta, {"id": pl.Int64, "drivingdirection": pl.Int64})
    unknown = ~cars["drivingdirection"].is_in([1, 2])
    what = "is neither 1 (upper lanes) nor 2 (lower lanes)"
    raise_where(unknown, cars, "drivingdirection", meta, what)
    raise_where(cars["id"].is_duplicated(), cars, "id", meta, "stands there twice")

    rows = read_table(path, COLUMNS)
    count.read += rows.height
    raise_unless_positive(rows, ("width", "height"), path)
    # Sorting would hide a damaged frame number.
    step = rows.select(pl.col("frame").diff().over("id")).to_series()
    what = "is not after the last frame of its vehicle; frames must grow"
    raise_where(step <= 0, rows, "frame", path, what)

    # Each row gets the direction of its vehicle.
    rows = rows.join(cars.drop(LINE), on="id", how="left", maintain_order="left")
    what = "is not in the tracksMeta file"
    raise_where(rows["drivingdirection"].is_null(), rows, "id", path, what)
    return rows.sort("id", "frame")


def _scene(
    rows: pl.DataFrame,
    direction: _Direction,
    rate_hz: float,
    name: str,
    path: Path,
    count: RowCount,
) -> Scene | None:
    """One direction in the schema, with a frame every 0.1 s; None where it has no vehicles.

    Args:
        rows: of both directions, as recorded.
        direction: the one that is wanted.
        rate_hz: frames per second of the recording.
        name: of the scene.
        path: file that a mistake is reported of.
        count: rows dropped are added to it.
    """
    rows = rows.filter(pl.col("drivingdirection") == direction.number)
    # A lane id of the other direction, or none, is an error of the tracking.
    on_road = rows["laneid"].is_in(list(direction.lane_ids))
    count.drop("off the lanes of its direction", (~on_road).sum())
    rows = rows.filter(on_road)
    if rows.is_empty():
        return None

    # Distances grow in the direction of travel. The file has the upper left corner of a vehicle's
    # box, the schema its centre.
    forward = direction.forward
    along = forward * (pl.col("x") + 0.5 * pl.col("width"))
    # Upper lanes: left is down in the image, where y grows; lower lanes: left is up.
    left = -forward * (pl.col("y") + 0.5 * pl.col("height") - direction.right_edge)
    numbers = {lane_id: lane for lane, lane_id in enumerate(direction.lane_ids)}
    turned = rows.select(
        "frame",
        scene=pl.lit(name),
        vehicle="id",
        x=along - along.min(),
        y=left - 0.5 * direction.lane_width,
        speed=forward * pl.col("xvelocity"),
        lane=pl.col("laneid").replace_strict(numbers, return_dtype=pl.Int64),
        length="width",
        width="height",
    )

    # Rows that were dropped split a track: nothing is interpolated across a gap.
    tracks = number_tracks(turned, str(path)).partition_by("vehicle", maintain_order=True)
    frame = pl.concat([resample(track, rate_hz) for track in tracks])
    frame = validate(frame, f"{path}, {name}", first_line=None)
    return Scene(name, sort(frame), direction.lane_width)


def resample(track: pl.DataFrame, rate_hz: float) -> pl.DataFrame:
    """A track without missing frames, which are ``1 / rate_hz`` s apart, at 10 Hz.

    Frame 0 is the old frame 0; no sample lies beyond the ends of the track.
    """
    # Old frames in a new one.
    per_step = rate_hz * FRAME_S
    old = track["frame"].to_numpy()
    # A small tolerance, so that a new frame at the time of an old one stays in spite of rounding.
    first = np.ceil(old[0] / per_step - 1e-9)
    last = np.floor(old[-1] / per_step + 1e-9)
    frame = np.arange(first, last + 1.0)

    # Places of the new frames among the old samples.
    place = (frame * per_step - old[0]).clip(0.0, len(old) - 1)
    # Half way between two samples, the earlier one counts.
    nearest = np.ceil(place - 0.5 - 1e-9).astype(np.int64)
    # Numbers are interpolated; lane and names are those of the nearest sample.
    samples = np.arange(len(old))
    columns = {}
    for name in ("x", "y", "speed", "length", "width"):
        columns[name] = np.interp(place, samples, track[name].to_numpy())
    return track[nearest].with_columns(frame=frame.astype(np.int64), **columns)
