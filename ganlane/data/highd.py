"""highD recordings (Krajewski et al. 2018): three files each, 25 Hz, two directions of travel, into the schema.

Each direction becomes a scene of its own, seen as its drivers see it: ``x`` forward, ``y`` to the left, lane 0
rightmost. highD's pictures have ``y`` downwards and call the length of a vehicle its ``width``; ``x, y`` are the
upper left corner of its box, from which half a box leads to the centre. Vehicles of the upper lanes (direction 1)
drive to the left in the picture, those of the lower lanes (direction 2) to the right. Positions and speeds are
interpolated linearly to 10 Hz; a sample's lane is that of the nearest recorded one. Positions are not smoothed.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
import polars as pl

from ganlane.data.blocks import BLOCK_BYTES, LINE, read_blocks
from ganlane.data.highd_directions import Direction, as_driven, both_directions
from ganlane.data.highd_meta import UPPER, HighdMeta, highd_meta
from ganlane.data.layout import csv_table
from ganlane.data.resampling import resampling
from ganlane.data.schema import SCHEMA, sort, validate
from ganlane.data.source import RowCount, Scene, number_tracks
from ganlane.data.tables import convert, refuse
from ganlane.errors import UserError

_TRACKS: Final = "_tracks.csv"
#: Columns of ``XX_tracks.csv`` that are used.
COLUMNS: Final = {
    "frame": pl.Int64,
    "id": pl.Int64,
    "x": pl.Float64,
    "y": pl.Float64,
    "width": pl.Float64,
    "height": pl.Float64,
    "xvelocity": pl.Float64,
    "laneid": pl.Int64,
}


def highd_scenes(path: str | Path, count: RowCount | None = None) -> Iterator[Scene]:
    """Two scenes, ``highd-XX-upper`` and ``highd-XX-lower``, for each recording.

    Args:
        path: an ``XX_tracks.csv``, beside which ``XX_tracksMeta.csv`` and ``XX_recordingMeta.csv`` stand, or a folder
            of such.
        count: rows read and dropped are added to it.

    Raises:
        UserError: a missing or damaged file; the message names file, line and column.
    """
    count = count if count is not None else RowCount()
    for tracks in _recordings(Path(path)):
        meta = highd_meta(tracks, _TRACKS)
        rows = _rows(tracks, meta, count)
        for direction in both_directions(meta):
            scene = _scene(rows, direction, meta, tracks, count)
            if scene is not None:
                yield scene


def read_highd(path: str | Path) -> pl.DataFrame:
    """One recording, or a folder of them, in the schema, sorted (see :func:`highd_scenes`)."""
    return pl.concat([scene.frame for scene in highd_scenes(path)])


def _recordings(path: Path) -> list[Path]:
    """The tracks files that ``path`` means."""
    if path.is_dir():
        found = sorted(path.glob(f"*{_TRACKS}"))
        if not found:
            raise UserError(f"{path}: no XX{_TRACKS} in this folder; give highD's data folder or one such file.")
        return found
    if not path.name.endswith(_TRACKS):
        raise UserError(f"{path}: expected highD's XX{_TRACKS} or a folder of recordings.")
    return [path]


def _rows(path: Path, meta: HighdMeta, count: RowCount) -> pl.DataFrame:
    """Rows of the tracks file, sorted by vehicle and frame, with each vehicle's direction."""
    table = csv_table(path, COLUMNS)
    blocks = []
    for text in read_blocks(table, list(COLUMNS), BLOCK_BYTES):
        lines = text[LINE]
        typed = [convert(text[name], kind, path, lines) for name, kind in COLUMNS.items()]
        blocks.append(pl.DataFrame([*typed, lines]))
    if not blocks:
        raise UserError(f"{path}: a header but no rows; copy or unpack the recording again.")
    rows = pl.concat(blocks)
    count.read += rows.height
    for name in ("width", "height"):
        refuse(rows[name] <= 0.0, rows[name], path, "is not above 0", rows[LINE])
    _refuse_disorder(rows, path)
    directions = rows["id"].replace_strict(meta.directions, default=None, return_dtype=pl.Int64)
    refuse(directions.is_null(), rows["id"], path, "is not in the tracksMeta file", rows[LINE])
    return rows.with_columns(directions.alias("direction")).sort("id", "frame")


def _refuse_disorder(rows: pl.DataFrame, path: Path) -> None:
    """A vehicle's frames grow in the order of the file."""
    step = rows.select(pl.col("frame").diff().over("id")).to_series()
    what = "is not after the last frame of its vehicle; frames must grow"
    refuse((step <= 0).fill_null(False), rows["frame"], path, what, rows[LINE])


def _scene(rows: pl.DataFrame, direction: Direction, meta: HighdMeta, path: Path, count: RowCount) -> Scene | None:
    """One direction in the schema; None where nobody drives that way."""
    rows = rows.filter((pl.col("direction") == UPPER) == direction.upper)
    on_road = rows["laneid"].is_in(list(direction.lane_ids))
    count.drop("off the lanes of its direction", int((~on_road).sum()))
    rows = rows.filter(on_road)
    if rows.is_empty():
        return None
    name = f"highd-{path.name.removesuffix(_TRACKS)}-{'upper' if direction.upper else 'lower'}"
    recorded = as_driven(rows, direction, name)
    numbered = number_tracks(recorded, str(path))
    frame = _at_ten_hertz(numbered, meta.rate_hz)
    if frame.is_empty():
        return None
    return Scene(name, sort(validate(frame, f"{path}, {name}", first_line=None)), direction.lane_width)


def _at_ten_hertz(rows: pl.DataFrame, rate_hz: float) -> pl.DataFrame:
    """The tracks every 0.1 s."""
    begins = (rows["vehicle"].diff() != 0).fill_null(True).to_numpy()
    new = resampling(np.asarray(begins), rows["frame"].to_numpy(), rate_hz)
    kept = {name: new.linear(rows[name].to_numpy()) for name in ("x", "y", "speed", "length", "width")}
    whole = {name: rows[name].to_numpy()[new.before] for name in ("scene", "vehicle")}
    lanes = new.nearest(rows["lane"].to_numpy())
    return pl.DataFrame({**whole, "frame": new.frame, **kept, "lane": lanes}, schema_overrides=SCHEMA).select(
        SCHEMA.names()
    )
