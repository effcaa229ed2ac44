"""What stands beside a highD tracks file: frame rate, lane markings, and each vehicle's direction."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

import polars as pl

from ganlane.data.tables import FIRST_LINE, read_table, refuse
from ganlane.errors import UserError

#: ``drivingDirection`` of the upper lanes, which are driven to the left; 2 is the lower ones.
UPPER: Final = 1
LOWER: Final = 2


@dataclass(frozen=True)
class HighdMeta:
    """Attributes of one recording.

    Attributes:
        rate_hz: frames a second.
        upper_markings, lower_markings: ``y`` of the lane markings in the picture, m, downwards.
        directions: vehicle to :data:`UPPER` or :data:`LOWER`.
    """

    rate_hz: float
    upper_markings: tuple[float, ...]
    lower_markings: tuple[float, ...]
    directions: dict[int, int]


def highd_meta(tracks: Path, ending: str) -> HighdMeta:
    """Read the two files beside ``tracks``, whose name ends in ``ending``.

    Raises:
        UserError: one is missing or damaged.
    """
    stem = tracks.name.removesuffix(ending)
    recording = tracks.with_name(f"{stem}_recordingMeta.csv")
    vehicles = tracks.with_name(f"{stem}_tracksMeta.csv")
    columns = {"frameRate": pl.Float64, "upperLaneMarkings": pl.String, "lowerLaneMarkings": pl.String}
    row = read_table(recording, columns).row(0, named=True)
    if row["frameRate"] < 10.0:
        raise UserError(f"{recording}, line 2, column frameRate: {row['frameRate']}, expected 10 Hz or more.")
    ways = read_table(vehicles, {"id": pl.Int64, "drivingDirection": pl.Int64})
    way = ways["drivingDirection"]
    refuse(~way.is_in([UPPER, LOWER]), way, vehicles, "is neither 1 (upper lanes) nor 2 (lower lanes)")
    return HighdMeta(
        row["frameRate"],
        _markings(row["upperLaneMarkings"], recording, "upperLaneMarkings"),
        _markings(row["lowerLaneMarkings"], recording, "lowerLaneMarkings"),
        dict(ways.iter_rows()),
    )


def _markings(text: str, path: Path, column: str) -> tuple[float, ...]:
    """``8.51;12.59;16.43`` as numbers."""
    try:
        found = tuple(float(part) for part in text.split(";") if part.strip())
    except ValueError:
        found = ()
    if len(found) < 2 or any(b <= a for a, b in pairwise(found)):
        raise UserError(
            f"{path}, line {FIRST_LINE}, column {column}: {text!r}; expected two or more growing numbers parted by ;"
        )
    return found
