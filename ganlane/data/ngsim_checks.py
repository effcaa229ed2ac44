"""What NGSIM rows of one period cannot be: out of order, or in other units than feet and seconds."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import polars as pl

from ganlane.data.blocks import LINE
from ganlane.data.ngsim_periods import FRAME_MS
from ganlane.data.tables import refuse
from ganlane.errors import UserError

#: Medians of vehicle lengths that can be feet: 15 is usual, 4.5 would be metres, 450 centimetres.
LENGTHS_FT: Final = (8.0, 40.0)
#: Distance covered over speed times time. Recordings give 1.00; km/h give 0.91, miles per hour 1.47.
PACE: Final = (0.94, 1.06)
#: Tracks that tell the pace: of at least 2 s, at 10 ft/s or more.
_PACE_FRAMES, _PACE_FT_S = 20, 10.0


def refuse_disorder(rows: pl.DataFrame, path: Path) -> None:
    """Frames must grow with time, and be 100 ms apart."""
    step_ms, frames = pl.col("global_time").diff(), pl.col("frame_id").diff()
    told = rows.select(same=(pl.col("vehicle_id").diff() == 0).fill_null(False), step=step_ms, frames=frames)
    backwards = (told["same"] & (told["frames"] <= 0)).fill_null(False)
    refuse(backwards, rows["frame_id"], path, "does not grow with global_time within its vehicle", rows[LINE])
    apart = (told["same"] & (told["step"] != FRAME_MS * told["frames"])).fill_null(False)
    refuse(apart, rows["global_time"], path, "is not 100 ms a frame after the row before", rows[LINE])


def refuse_units(rows: pl.DataFrame, source: str) -> None:
    """Lengths, positions or speeds that cannot be in feet and seconds."""
    line = int(rows[LINE].min())  # type: ignore[arg-type]
    length = float(rows["v_length"].median())  # type: ignore[arg-type]
    if not LENGTHS_FT[0] <= length <= LENGTHS_FT[1]:
        guess = "they look like metres" if length < LENGTHS_FT[0] else "they look like centimetres or inches"
        raise UserError(
            f"{source}, from line {line}, column v_length: the median is {length:.1f}, expected feet, about 15; "
            f"{guess}, convert all columns to feet."
        )
    pace = _pace(rows)
    if pace is not None and not PACE[0] <= pace <= PACE[1]:
        raise UserError(
            f"{source}, from line {line}, columns local_y and v_vel: vehicles cover {pace:.2f} times the distance "
            "that their speed makes; expected feet and feet per second (0.91 would be km/h, 1.47 miles per hour, "
            "3.28 m/s), convert v_vel."
        )


def _pace(rows: pl.DataFrame) -> float | None:
    """Median over the vehicles of the distance covered over the one that the mean speed makes."""
    covered = pl.col("local_y").last() - pl.col("local_y").first()
    seconds = (pl.col("global_time").last() - pl.col("global_time").first()) / 1000.0
    per_vehicle = rows.group_by("vehicle_id", maintain_order=True).agg(
        ratio=covered / (seconds * pl.col("v_vel").mean()), rows=pl.len(), speed=pl.col("v_vel").mean()
    )
    told = per_vehicle.filter((pl.col("rows") >= _PACE_FRAMES) & (pl.col("speed") >= _PACE_FT_S))
    return float(told["ratio"].median()) if told.height else None  # type: ignore[arg-type]
