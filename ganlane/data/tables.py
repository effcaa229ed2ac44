"""Reading a comma-separated table of numbers, with every fault traced to its line and column."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import polars as pl

from ganlane.errors import UserError

#: The header is line 1, so the first row of numbers is line 2.
FIRST_LINE = 2
#: ``1,118,846,980,200``: commas that part thousands, as against those of a decimal comma.
_THOUSANDS: Final = r"^[+-]?\d{1,3}(,\d{3})+(\.\d*)?$"

Kind = pl.DataType | type[pl.DataType]


def read_table(path: str | Path, columns: Mapping[str, Kind]) -> pl.DataFrame:
    """Read the named ``columns`` of a CSV file with a header, in file order; other columns are left out.

    Args:
        path: the file.
        columns: name to polars type: ``String``, ``Int64`` (a whole number; ``3.0`` counts as one) or
            ``Float64`` (a finite number).

    Raises:
        UserError: no such file, no text table, no rows, a missing column, or a field that is empty or not the
            number expected; the message names file, line and column.
    """
    path = Path(path)
    text = _read_text(path)
    refuse_missing(columns, text.columns, path)
    if text.is_empty():
        raise UserError(f"{path}: a header but no rows; give a file with at least one row of data.")
    return text.select(convert(text[name], kind, path) for name, kind in columns.items())


def refuse_missing(wanted: Mapping[str, Kind], found: list[str], path: Path) -> None:
    """Name the columns that are not there.

    Raises:
        UserError: one of ``wanted`` is not among ``found``.
    """
    missing = [name for name in wanted if name not in found]
    if missing:
        raise UserError(
            f"{path}, line 1: no column {', '.join(missing)}; found {', '.join(found)}; expected {', '.join(wanted)}."
        )


def _read_text(path: Path) -> pl.DataFrame:
    """The whole table as text."""
    if not path.is_file():
        raise UserError(f"{path}: no such file; give the path of a CSV file.")
    try:
        return pl.read_csv(path, infer_schema=False)
    except pl.exceptions.NoDataError as error:
        raise UserError(f"{path}: the file is empty; a CSV file with a header was expected.") from error
    except (pl.exceptions.PolarsError, OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: not a readable CSV table ({_first_line(error)}).") from error


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0].rstrip(". ")


def convert(
    text: pl.Series, kind: Kind, path: Path, lines: pl.Series | None = None, thousands: bool = False
) -> pl.Series:
    """One column of text as ``kind``.

    Args:
        text: the column.
        kind: ``String``, ``Int64`` or ``Float64``.
        path: for messages.
        lines: the line of each row, for messages; by default they follow a header.
        thousands: whether commas may part thousands.

    Raises:
        UserError: a field is empty or not what was expected; the first one is named by file, line and column.
    """
    text = text.str.strip_chars()
    refuse(text.is_null() | (text == ""), text, path, "is empty; the row is incomplete", lines)
    if kind == pl.String:
        return text
    plain = _without_thousands(text) if thousands else text
    numbers = plain.cast(pl.Float64, strict=False)
    if numbers.null_count():
        refuse(numbers.is_null(), text, path, "is not a number", lines)
    refuse(~numbers.is_finite(), text, path, "is not a finite number", lines)
    if kind == pl.Int64:
        refuse(numbers != numbers.round(), text, path, "is not a whole number", lines)
    return numbers.cast(kind)


def _without_thousands(text: pl.Series) -> pl.Series:
    """Without commas where they part thousands; elsewhere they stay, and make no number."""
    grouped = pl.col("field").str.contains(_THOUSANDS)
    plain = pl.when(grouped).then(pl.col("field").str.replace_all(",", "", literal=True)).otherwise("field")
    return pl.DataFrame({"field": text}).select(plain.alias(text.name))[text.name]


def refuse(bad: pl.Series, values: pl.Series, path: Path, what: str, lines: pl.Series | None = None) -> None:
    """Report the first row that is ``bad``, if any.

    Raises:
        UserError: naming file, line, column and value.
    """
    row = bad.arg_max() if bad.any() else None
    if row is None:
        return
    value = values[row]
    field = "the field" if value in (None, "") else repr(value)
    line = row + FIRST_LINE if lines is None else lines[row]
    raise UserError(f"{path}, line {line}, column {values.name}: {field} {what}; mend or remove the row.")
