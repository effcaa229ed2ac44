"""What every reader hands over: scenes one by one, and what became of the rows of the file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import polars as pl

from ganlane.data.schema import TRACK_STRIDE
from ganlane.errors import UserError

#: Called with the bytes done so far and the total, None where that is unknown.
OnProgress = Callable[[int, int | None], None]


@dataclass
class RowCount:
    """Rows of the files read so far: how many, and how many of them were left out for which reason.

    Rows of the files are counted, not those that interpolation makes (highD).
    """

    read: int = 0
    dropped: Counter[str] = field(default_factory=Counter)

    @property
    def kept(self) -> int:
        """Rows read and not dropped."""
        return self.read - self.dropped.total()

    def drop(self, reason: str, rows: int) -> None:
        """Count ``rows`` left out for ``reason``."""
        if rows:
            self.dropped[reason] += int(rows)


@dataclass(frozen=True)
class Scene:
    """One recording in the schema, sorted, with the width of its lanes in metres."""

    name: str
    frame: pl.DataFrame
    lane_width_m: float

    @property
    def lanes(self) -> int:
        """Number of lanes: the highest and one."""
        return int(self.frame["lane"].max()) + 1  # type: ignore[arg-type]


def number_tracks(frame: pl.DataFrame, source: str) -> pl.DataFrame:
    """Give every stretch without a missing frame a track number of its own.

    A car's second stretch is numbered ``vehicle + TRACK_STRIDE``, its third ``vehicle + 2 TRACK_STRIDE``.

    Args:
        frame: at least ``vehicle`` and ``frame``, one scene, sorted by both.
        source: for messages.

    Raises:
        UserError: vehicle numbers that leave no room for that.
    """
    low, high = (int(end) for end in frame.select(low=pl.col("vehicle").min(), high=pl.col("vehicle").max()).row(0))
    if low < 0 or high >= TRACK_STRIDE:
        raise UserError(
            f"{source}: vehicle numbers from {low} to {high}; expected 0 to {TRACK_STRIDE - 1}, number them anew."
        )
    missing = (pl.col("frame").diff() != 1) & (pl.col("vehicle").diff() == 0)
    piece = missing.fill_null(False).cast(pl.Int64).cum_sum().over("vehicle")
    return frame.with_columns(vehicle=pl.col("vehicle") + TRACK_STRIDE * piece)
