"""Rows of an NGSIM file, raw text or portal CSV, as typed blocks: still in feet, in the order of the file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import polars as pl

from ganlane.data.blocks import BLOCK_BYTES, LINE, read_blocks
from ganlane.data.layout import TextTable, csv_table, first_line
from ganlane.data.source import OnProgress, RowCount
from ganlane.data.tables import convert, refuse
from ganlane.errors import UserError

#: The 18 columns of the raw text files, which have no header.
RAW_NAMES: Final = (
    *("vehicle_id", "frame_id", "total_frames", "global_time", "local_x", "local_y", "global_x", "global_y"),
    *("v_length", "v_width", "v_class", "v_vel", "v_acc", "lane_id", "preceding", "following"),
    *("space_headway", "time_headway"),
)
#: Columns that are used; ``location`` too, where there is one.
COLUMNS: Final = {
    "vehicle_id": pl.Int64,
    "frame_id": pl.Int64,
    "global_time": pl.Int64,
    "local_x": pl.Float64,
    "local_y": pl.Float64,
    "v_length": pl.Float64,
    "v_width": pl.Float64,
    "v_vel": pl.Float64,
    "lane_id": pl.Int64,
}
LOCATION: Final = "location"
#: Motorways, and streets with crossings: the places of the portal's file.
MOTORWAYS: Final = ("us-101", "i-80")
STREETS: Final = ("lankershim", "peachtree")


@dataclass(frozen=True)
class NgsimParameters:
    """What is taken of an NGSIM file.

    Attributes:
        locations: places to keep, where the file names them.
        lanes: lanes kept, from the left; on US-101 and I-80 the main lanes (and US-101's auxiliary lane) are 1 to 6
            and what follows are ramps.
        block_bytes: bytes read at once.
    """

    locations: tuple[str, ...] = MOTORWAYS
    lanes: int = 6
    block_bytes: int = BLOCK_BYTES


def ngsim_table(path: str | Path) -> TextTable:
    """The layout of an NGSIM file, told by its first line: numbers alone are raw text, else it is a header.

    Raises:
        UserError: neither 18 columns of numbers nor a header with the columns that are used.
    """
    path = Path(path)
    first = first_line(path)
    fields = first.split()
    if "," in first or not _is_number(fields[0]):
        return csv_table(path, COLUMNS)
    if len(fields) != len(RAW_NAMES):
        raise UserError(
            f"{path}, line 1: {len(fields)} columns; expected the {len(RAW_NAMES)} of NGSIM's text files, or a "
            "header line."
        )
    return TextTable(path, RAW_NAMES, has_header=False, blanks=True)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def ngsim_rows(
    table: TextTable, parameters: NgsimParameters, count: RowCount, on_progress: OnProgress | None = None
) -> Iterator[pl.DataFrame]:
    """Blocks with :data:`COLUMNS`, ``location`` and ``line``; other places are left out and counted.

    Raises:
        UserError: a damaged row; the message names file, line and column.
    """
    has_location = LOCATION in table.names
    wanted = [*COLUMNS, LOCATION] if has_location else list(COLUMNS)
    before: pl.DataFrame | None = None
    for text in read_blocks(table, wanted, parameters.block_bytes, on_progress):
        count.read += text.height
        text = _in_place(text, table.path, parameters, count) if has_location else _placed(text, table.path)
        block = _typed(text, table.path)
        if table.blanks:
            _refuse_disorder(block if before is None else pl.concat((before, block)), table.path)
            before = block.tail(1)
        yield block


def _placed(text: pl.DataFrame, path: Path) -> pl.DataFrame:
    """Files without a location hold one place, named like the file."""
    return text.with_columns(pl.lit(path.stem).alias(LOCATION))


def _in_place(text: pl.DataFrame, path: Path, parameters: NgsimParameters, count: RowCount) -> pl.DataFrame:
    """Rows of the places that are kept."""
    places = convert(text[LOCATION], pl.String, path, text[LINE]).str.to_lowercase()
    known = {*MOTORWAYS, *STREETS, *parameters.locations}
    expected = f"is no known place, expected {', '.join(sorted(known))}, or name it in data.locations"
    refuse(~places.is_in(list(known)), places, path, expected, text[LINE])
    kept = places.is_in(list(parameters.locations))
    others = places.filter(~kept).value_counts()
    for place, rows in others.iter_rows():
        count.drop(f"location {place}", rows)
    return text.with_columns(places).filter(kept)


def _typed(text: pl.DataFrame, path: Path) -> pl.DataFrame:
    """Numbers; negative sizes and speeds are refused."""
    lines = text[LINE]
    columns = {name: convert(text[name], kind, path, lines, thousands=True) for name, kind in COLUMNS.items()}
    for name in ("v_length", "v_width"):
        refuse(columns[name] <= 0.0, columns[name], path, "is not above 0", lines)
    refuse(columns["v_vel"] < 0.0, columns["v_vel"], path, "is below 0", lines)
    return pl.DataFrame([*columns.values(), text[LOCATION], lines])


def _refuse_disorder(rows: pl.DataFrame, path: Path) -> None:
    """In the raw files the rows of a vehicle follow each other in time."""
    same_vehicle = pl.col("vehicle_id").diff() == 0
    # Files put one after the other may meet at the same number, in another period.
    same_period = pl.col("global_time").diff().abs() < 60_000
    backwards = rows.select((same_vehicle & same_period & (pl.col("frame_id").diff() < 0)).fill_null(False))
    what = "is before the last frame of its vehicle; frames must grow"
    refuse(backwards.to_series(), rows["frame_id"], path, what, rows[LINE])
