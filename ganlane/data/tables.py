"""Reading a comma-separated table of numbers, with every fault traced to its line and column."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import polars as pl

from ganlane.errors import UserError

#: The header is line 1, so the first row of numbers is line 2.
FIRST_LINE = 2


def read_table(path: str | Path, columns: Mapping[str, pl.DataType | type[pl.DataType]]) -> pl.DataFrame:
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
    missing = [name for name in columns if name not in text.columns]
    if missing:
        raise UserError(
            f"{path}, line 1: no column {', '.join(missing)}; found {', '.join(text.columns)}; "
            f"expected {', '.join(columns)}."
        )
    if text.is_empty():
        raise UserError(f"{path}: a header but no rows; give a file with at least one row of data.")
    return text.select(_convert(text[name], kind, path) for name, kind in columns.items())


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


def _convert(text: pl.Series, kind: pl.DataType | type[pl.DataType], path: Path) -> pl.Series:
    """One column of text as ``kind``; the first field that does not fit is reported."""
    text = text.str.strip_chars()
    _refuse(text.is_null() | (text == ""), text, path, "is empty; the row is incomplete")
    if kind == pl.String:
        return text
    numbers = text.cast(pl.Float64, strict=False)
    _refuse(numbers.is_null(), text, path, "is not a number")
    _refuse(~numbers.is_finite(), text, path, "is not a finite number")
    if kind == pl.Int64:
        _refuse(numbers != numbers.round(), text, path, "is not a whole number")
    return numbers.cast(kind)


def _refuse(bad: pl.Series, text: pl.Series, path: Path, what: str) -> None:
    row = bad.arg_max()
    if row is not None and bad[row]:
        field = "the field" if text[row] in (None, "") else repr(text[row])
        raise UserError(
            f"{path}, line {row + FIRST_LINE}, column {text.name}: {field} {what}; mend or remove the row."
        )
