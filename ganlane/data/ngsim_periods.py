"""Which recording period an NGSIM row belongs to, and files of any size sorted into their periods.

Vehicle and frame numbers start anew in every period, so a number alone is nobody. Within a period
``global_time - 100 ms * frame_id`` is the same for every row: the instant of frame 0. Rows are put aside on disk by
the minute of that instant, block by block; neighbouring minutes are one period. So memory holds one block, then one
period, never the file, and a track that stretches over blocks is whole again.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import polars as pl

from ganlane.data.blocks import LINE
from ganlane.data.ngsim_rows import LOCATION
from ganlane.errors import UserError

#: Milliseconds between two frames, and the grain in which the instants of frame 0 are told apart.
FRAME_MS: Final = 100
MINUTE_MS: Final = 60_000
#: A file has six periods or so; a damaged column of times or frames makes hundreds.
MOST_MINUTES: Final = 500
#: A period beside others holds at least so many rows: a vehicle for 5 s.
FEWEST_ROWS: Final = 50


@dataclass(frozen=True)
class Period:
    """Rows of one place and period, in the parts that were put aside."""

    location: str
    number: int
    parts: tuple[Path, ...]

    @property
    def name(self) -> str:
        """``us-101-1`` for the first period of US-101."""
        return f"{self.location}-{self.number}"

    def read(self) -> pl.DataFrame:
        """All its rows, not sorted."""
        return pl.concat([pl.read_ipc(part) for part in self.parts])


def sort_into_periods(blocks: Iterable[pl.DataFrame], folder: Path, source: str) -> list[Period]:
    """Put the rows of all blocks aside under ``folder`` and return the periods, by place and time.

    Raises:
        UserError: ``global_time`` and ``frame_id`` do not go together; the message names line and column.
    """
    parts: dict[tuple[str, int], list[Path]] = {}
    for number, block in enumerate(blocks):
        for key, rows in _by_minute(block):
            part = folder / f"{len(parts):04d}-{number:05d}-{key[1]}.arrow"
            rows.drop(LOCATION).write_ipc(part, compression="lz4")
            parts.setdefault(key, []).append(part)
        if len(parts) > MOST_MINUTES:
            raise UserError(
                f"{source}, columns global_time and frame_id: they hold {len(parts)} recording periods or more; "
                "expected global_time in milliseconds and frame_id in steps of 100 ms."
            )
    periods = list(_periods(parts))
    for period in periods:
        is_small = len(period.parts) <= 1
        if is_small and sum(other.location == period.location for other in periods) > 1:
            _refuse_stray(period, source)
    return periods


def _by_minute(block: pl.DataFrame) -> Iterator[tuple[tuple[str, int], pl.DataFrame]]:
    """Rows by place and minute of frame 0."""
    start = (pl.col("global_time") - FRAME_MS * pl.col("frame_id")) // MINUTE_MS
    for (location, minute), rows in block.group_by(LOCATION, start.alias("minute"), maintain_order=True):
        yield (str(location), int(minute)), rows  # type: ignore[call-overload]


def _periods(parts: dict[tuple[str, int], list[Path]]) -> Iterator[Period]:
    """Neighbouring minutes of a place joined."""
    numbers: dict[str, int] = {}
    waiting: list[tuple[str, int]] = []
    for key in [*sorted(parts), None]:
        if waiting and (key is None or key != (waiting[-1][0], waiting[-1][1] + 1)):
            location = waiting[0][0]
            numbers[location] = numbers.get(location, 0) + 1
            together = tuple(part for minute in waiting for part in parts[minute])
            yield Period(location, numbers[location], together)
            waiting = []
        if key is not None:
            waiting.append(key)


def _refuse_stray(period: Period, source: str) -> None:
    """A few rows alone with their instant of frame 0, beside other periods, have a wrong time or frame."""
    rows = period.read()
    if rows.height < FEWEST_ROWS:
        first = rows.sort(LINE).row(0, named=True)
        raise UserError(
            f"{source}, line {first[LINE]}, columns frame_id and global_time: frame {first['frame_id']} at "
            f"{first['global_time']} ms fits no recording period of {period.location} ({rows.height} rows alone); "
            "mend or remove the row."
        )
