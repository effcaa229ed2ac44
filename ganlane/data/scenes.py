"""Scene CSV: recordings that are straightened already, in metres, with lanes counted from the left."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import polars as pl

from ganlane.data.lane_widths import lane_width, scene_lane_widths
from ganlane.data.prepared import is_prepared, note_scene, prepared_files, read_prepared
from ganlane.data.schema import SCHEMA, sort, validate
from ganlane.data.source import RowCount, Scene
from ganlane.data.tables import FIRST_LINE, read_table
from ganlane.errors import UserError

#: Columns of the file; ``y`` is 0 at the centre of lane 1, which is the leftmost, and grows to the left.
COLUMNS: Final = {
    "scene": pl.String,
    "vehicle": pl.Int64,
    "frame": pl.Int64,
    "x": pl.Float64,
    "y": pl.Float64,
    "v": pl.Float64,
    "lane": pl.Int64,
    "length": pl.Float64,
    "width": pl.Float64,
}


def read_scenes(path: str | Path) -> pl.DataFrame:
    """Read a scene CSV, or what ``ganlane prepare`` wrote, into the schema, sorted by scene, vehicle and frame.

    Lanes are turned round (the highest number of a scene, its rightmost lane, becomes 0), and ``y`` is moved so
    that it is 0 at the centre of that lane. Positions are the file's own: nothing is smoothed.

    Args:
        path: CSV with the columns ``scene, vehicle, frame, x, y, v, lane, length, width`` (others are ignored);
            metres, m/s, 0.1 s a frame; lane 1 leftmost. Or Parquet in the schema: a file ``*.parquet``, or a folder
            of them.

    Raises:
        UserError: a missing or damaged file; the message names file, line and column.
    """
    if is_prepared(path):
        return read_prepared(path)
    table = read_table(path, COLUMNS).rename({"v": "speed"})
    below = table["lane"] < 1
    if below.any():
        row = int(below.arg_max() or 0)
        raise UserError(
            f"{path}, line {row + FIRST_LINE}, column lane: {table['lane'][row]} is below 1, the leftmost lane."
        )
    rows = validate(table, str(path))
    turned = [_turn_round(scene, f"{path}, scene {name}") for (name,), scene in rows.group_by("scene")]
    return sort(pl.concat(turned))


def scene_csv_scenes(path: str | Path, count: RowCount | None = None) -> Iterator[Scene]:
    """The scenes of :func:`read_scenes` one by one; ``count`` gets the rows read. Each file is read at once."""
    seen: dict[str, Path] = {}
    for file in prepared_files(path) if is_prepared(path) else [Path(path)]:
        frame = read_scenes(file)
        if count is not None:
            count.read += frame.height
        widths = scene_lane_widths(frame)
        for (name,), rows in frame.group_by("scene", maintain_order=True):
            note_scene(str(name), file, seen)
            yield Scene(str(name), rows, widths[str(name)])


def _turn_round(scene: pl.DataFrame, source: str) -> pl.DataFrame:
    """One scene with lanes counted from the right and ``y`` measured from the rightmost lane's centre."""
    from_left = scene["lane"].to_numpy() - 1
    width = lane_width(-scene["y"].to_numpy(), from_left, source)
    last = int(from_left.max())
    return scene.with_columns(y=pl.col("y") + last * width, lane=last + 1 - pl.col("lane")).select(SCHEMA.names())
