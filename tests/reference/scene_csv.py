"""Scene CSVs of frames in the schema."""

from __future__ import annotations

from pathlib import Path

import polars as pl

from ganlane.data.recordings import COLUMNS


def write_scene_csv(frame: pl.DataFrame, path: str | Path) -> None:
    """Write a frame in the schema, with lanes of 3.5 m, as a scene CSV.

    Lane 1 is the leftmost in use in a scene.
    """
    scene_csv(frame, pl.col("lane").max().over("scene"), 3.5).write_csv(path)


def scene_csv(
    frame: pl.DataFrame,
    leftmost: pl.Expr,
    lane_width_m: float,
) -> pl.DataFrame:
    """A frame in the schema as the columns of a scene CSV.

    ``leftmost`` is the number of the leftmost lane.
    """
    columns = frame.with_columns(
        # A scene CSV counts lanes from the left, from 1, and y from the leftmost lane.
        v=pl.col("speed"),
        lane=leftmost + 1 - pl.col("lane"),
        y=pl.col("y") - leftmost * lane_width_m,
    )
    return columns.select(COLUMNS.keys())
