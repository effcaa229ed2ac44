"""Accelerations of a recording, as they come and over a second. For statistics only.

**Never build a generator's windows from smoothed positions**: a filter that looks ahead leaks the future into the
past. Nothing here writes positions.
"""

from __future__ import annotations

import polars as pl

from ganlane.data.schema import FRAME_S, TRACK


def raw_accelerations(frame: pl.DataFrame) -> pl.Series:
    """Differences of the recorded speed from frame to frame, m/s2; mostly noise in raw recordings."""
    steps = frame.select(((pl.col("speed") - _earlier("speed", 1)) / FRAME_S).alias("acceleration"))
    return steps["acceleration"].drop_nulls()


def smoothed_accelerations(frame: pl.DataFrame, over_s: float = 1.0) -> pl.Series:
    """Mean speed of one second less the mean speed of the second before, over a second, m/s2.

    The filter is ``(x[t] - 2 x[t - k] + x[t - 2k]) / (k * 0.1 s)^2`` with ``k`` frames in ``over_s``: the true
    acceleration weighted by a triangle of two seconds' width. It is taken from positions, so recordings and
    simulations are treated alike; a track of less than two seconds has none.
    """
    lag = round(over_s / FRAME_S)
    bend = (pl.col("x") - 2.0 * _earlier("x", lag) + _earlier("x", 2 * lag)) / (lag * FRAME_S) ** 2
    return frame.select(bend.alias("acceleration"))["acceleration"].drop_nulls()


def _earlier(column: str, frames: int) -> pl.Expr:
    """The column's value ``frames`` earlier in the same track; null where it is missing or a frame between is."""
    same = pl.col("frame").shift(frames).over(TRACK) == pl.col("frame") - frames
    return pl.when(same).then(pl.col(column).shift(frames).over(TRACK))
