"""Scene CSVs of frames in the schema."""

from __future__ import annotations

from pathlib import Path

import polars as pl

from ganlane.data.recordings import COLUMNS


def write_scene_csv(frame: pl.DataFrame, path: str | Path) -> None:
    """Write a frame in the schema, with lanes of 3.5 m, as a scene CSV.

    Lane 1 is the leftmost in use in a scene.
    """
    leftmost = pl.col("lane").max().over("scene")
    columns = frame.with_columns(
        # A scene CSV counts lanes from the left, from 1, and y from the leftmost lane.
        v=pl.col("speed"),
        lane=leftmost + 1 - pl.col("lane"),
        y=pl.col("y") - leftmost * 3.5,
    )
    columns.select(COLUMNS.keys()).write_csv(path)
