"""NGSIM recordings: raw text files and the portal's CSV, in feet, into the schema.

Feet become metres; the front centre becomes the centre of the body; lanes, which NGSIM counts from the left, are
counted from the right, and ``y``, there from the left edge to the right, is measured from the rightmost lane's
centre to the left. Rows on ramps (lanes beyond ``lanes``) are left out: a ramp is no lane beside the others. US-101's
auxiliary lane (6) stays, as the rightmost. A car's track ends where a frame is missing or a ramp begins.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
import polars as pl

from ganlane.data.blocks import LINE
from ganlane.data.lane_widths import lane_grid
from ganlane.data.ngsim_checks import refuse_disorder, refuse_units
from ganlane.data.ngsim_periods import Period, sort_into_periods
from ganlane.data.ngsim_rows import COLUMNS, NgsimParameters, ngsim_rows, ngsim_table
from ganlane.data.schema import SCHEMA, sort
from ganlane.data.source import OnProgress, RowCount, Scene, number_tracks
from ganlane.errors import UserError

FOOT_M: Final = 0.3048
#: Rows that tell how wide the lanes are and where they lie.
ROWS_FOR_LANES: Final = 500_000


def ngsim_scenes(
    path: str | Path,
    parameters: NgsimParameters | None = None,
    count: RowCount | None = None,
    scratch: Path | None = None,
    on_progress: OnProgress | None = None,
) -> Iterator[Scene]:
    """The periods of an NGSIM file, one scene each, in bounded memory (a block, then a period).

    Args:
        path: a raw text file (18 columns, no header) or a CSV with NGSIM's column names, in any case and order; with
            a column ``location`` several places may stand in it.
        parameters: what to take of it.
        count: rows read and dropped are added to it.
        scratch: folder for the rows that are put aside; by default a temporary one. It is emptied in the end.
        on_progress: called with the bytes read.

    Raises:
        UserError: a missing or damaged file; the message names file, line and column.
    """
    parameters, count = parameters or NgsimParameters(), count if count is not None else RowCount()
    table = ngsim_table(path)
    with tempfile.TemporaryDirectory(dir=scratch, prefix="rows-") as folder:
        periods = sort_into_periods(ngsim_rows(table, parameters, count, on_progress), Path(folder), str(path))
        if not periods:
            places = ", ".join(parameters.locations)
            raise UserError(f"{path}: no rows of {places}; check data.locations.")
        for period in periods:
            scene = _scene(period, str(path), parameters.lanes, count)
            if scene is not None:
                yield scene


def read_ngsim(path: str | Path, parameters: NgsimParameters | None = None) -> pl.DataFrame:
    """A whole NGSIM file in the schema, sorted; for files that fit into memory (see :func:`ngsim_scenes`)."""
    return pl.concat([scene.frame for scene in ngsim_scenes(path, parameters)])


def _scene(period: Period, source: str, lanes: int, count: RowCount) -> Scene | None:
    """One period in the schema; None where none of its rows is on a lane."""
    rows = _without_repetitions(period.read(), count)
    refuse_disorder(rows, Path(source))
    refuse_units(rows, f"{source}, {period.name}")
    on_road = rows["lane_id"].is_between(1, lanes)
    count.drop("lane below 1", int((rows["lane_id"] < 1).sum()))
    count.drop("ramp", int((rows["lane_id"] > lanes).sum()))
    rows = rows.filter(on_road)
    if rows.is_empty():
        return None
    metric, width = _turned_round(rows, f"{source}, {period.name}")
    frame = metric.select(
        pl.lit(period.name).alias("scene"),
        pl.col("vehicle_id").alias("vehicle"),
        pl.col("frame_id").alias("frame"),
        x=FOOT_M * (pl.col("local_y") - 0.5 * pl.col("v_length")),
        y="y",
        speed=FOOT_M * pl.col("v_vel"),
        lane="lane",
        length=FOOT_M * pl.col("v_length"),
        width=FOOT_M * pl.col("v_width"),
    )
    return Scene(period.name, sort(number_tracks(frame, source)).select(SCHEMA.names()), width)


def _without_repetitions(rows: pl.DataFrame, count: RowCount) -> pl.DataFrame:
    """Rows by vehicle and time; of rows of one vehicle at one time the first in the file stays."""
    rows = rows.sort("vehicle_id", "global_time", LINE)
    again = (pl.col("vehicle_id").diff() == 0) & (pl.col("global_time").diff() == 0)
    values = [name for name in COLUMNS if name not in ("vehicle_id", "global_time")]
    same = pl.all_horizontal(pl.col(name) == pl.col(name).shift(1) for name in values)
    told = rows.select(again.fill_null(False).alias("again"), same.fill_null(False).alias("same"))
    count.drop("duplicate", int((told["again"] & told["same"]).sum()))
    count.drop("same vehicle and time, other values", int((told["again"] & ~told["same"]).sum()))
    return rows.filter(~told["again"])


def _turned_round(rows: pl.DataFrame, source: str) -> tuple[pl.DataFrame, float]:
    """Lanes from the right and ``y`` in metres to the left of the rightmost lane's centre; and the lane width."""
    from_left = rows["lane_id"].to_numpy() - 1
    right_m = FOOT_M * rows["local_x"].to_numpy()
    # Every so many rows tell as much of the lanes, in bounded memory.
    told = slice(None, None, -(-len(right_m) // ROWS_FOR_LANES))
    width, first_centre = lane_grid(right_m[told], from_left[told], source)
    last = int(from_left.max())
    y = last * width - (right_m - first_centre)
    return rows.with_columns(y=np.asarray(y), lane=pl.Series(last - from_left)), width
