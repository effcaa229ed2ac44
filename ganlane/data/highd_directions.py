"""The two directions of travel of a highD recording, each seen as its drivers see it."""

from __future__ import annotations

from dataclasses import dataclass

import polars as pl

from ganlane.data.highd_meta import HighdMeta


@dataclass(frozen=True)
class Direction:
    """One direction of travel: its lanes, from the rightmost, as highD numbers them, and the road's right edge."""

    upper: bool
    lane_ids: tuple[int, ...]
    right_edge: float
    lane_width: float


def both_directions(meta: HighdMeta) -> list[Direction]:
    """Both directions. Lane numbers grow downwards, the number before the first lane and between being no lane's."""
    upper, lower = meta.upper_markings, meta.lower_markings
    n_upper, n_lower = len(upper) - 1, len(lower) - 1
    above = tuple(range(2, 2 + n_upper))
    below = tuple(range(n_upper + 3, n_upper + 3 + n_lower))
    return [
        Direction(True, above, upper[0], (upper[-1] - upper[0]) / n_upper),
        Direction(False, below[::-1], lower[-1], (lower[-1] - lower[0]) / n_lower),
    ]


def as_driven(rows: pl.DataFrame, direction: Direction, name: str) -> pl.DataFrame:
    """As the drivers see it: forward, to the left, from the right; still at the recorded rate."""
    forward = -1.0 if direction.upper else 1.0
    along = forward * (pl.col("x") + 0.5 * pl.col("width"))
    # Upper lanes: left is down the picture, where y grows; lower lanes: left is up.
    left = -forward * (pl.col("y") + 0.5 * pl.col("height") - direction.right_edge)
    numbers = {lane_id: lane for lane, lane_id in enumerate(direction.lane_ids)}
    return rows.select(
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
