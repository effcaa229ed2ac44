"""Text tables as typed columns, with every error traced to its line and column.

Files are read block by block (:func:`read_blocks`), as text that :func:`convert` turns into numbers;
:func:`read_table` does both for a CSV file that fits into memory.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import polars as pl

from ganlane.errors import UserError
from ganlane.parameters.generator import BLOCK_BYTES

#: Line of the first row of data below a header, which is line 1.
FIRST_LINE: Final = 2
#: Column that holds each row's line number in the file.
LINE: Final = "line"
#: ``1,118,846,980,200``: commas that separate thousands, unlike a decimal comma.
_THOUSANDS: Final = r"^[+-]?\d{1,3}(,\d{3})+(\.\d*)?$"

Kind = pl.DataType | type[pl.DataType]
#: Called with the bytes done so far and the total, None where the total is unknown.
OnProgress = Callable[[int, int | None], None]


@dataclass(frozen=True)
class TextTable:
    """Layout of a text table; ``names`` are those of its columns, in lower case.

    With ``blanks``, runs of blanks separate the columns, instead of a comma.
    """

    path: Path
    names: tuple[str, ...]
    has_header: bool = True
    blanks: bool = False


def read_table(path: str | Path, columns: Mapping[str, Kind]) -> pl.DataFrame:
    """The named ``columns`` of a CSV file, typed by :func:`convert`, and ``line``; rows in the order of the file.

    Raises:
        UserError: no such file, no text table, no rows, a missing column, or a field that is empty or not the
            number expected; the message names file, line and column.
    """
    path = Path(path)
    blocks = [
        pl.DataFrame([*(convert(text[name], kind, path, text[LINE]) for name, kind in columns.items()), text[LINE]])
        for text in read_blocks(csv_table(path, columns), list(columns))
    ]
    if not blocks:
        raise UserError(f"{path}: a header but no rows; give a file with at least one row of data.")
    return pl.concat(blocks)


def csv_table(path: Path, wanted: Iterable[str]) -> TextTable:
    """Layout of a CSV file according to its header line, which must hold the ``wanted`` columns in any case."""
    names = tuple(name.strip().lower() for name in _cells(first_line(path), f"{path}, line 1"))
    missing = [name for name in wanted if name not in names]
    if missing:
        raise UserError(
            f"{path}, line 1: no column {', '.join(missing)}; found {', '.join(names)}; expected {', '.join(wanted)}."
        )
    return TextTable(path, names)


def first_line(path: Path) -> str:
    """The first line of a text file, without a byte order mark."""
    if not path.is_file():
        raise UserError(f"{path}: no such file; give the path of a text table.")
    with path.open("rb") as file:
        raw = file.readline(2**16)
    try:
        text = raw.decode("utf-8-sig").strip()
    except UnicodeDecodeError as error:
        raise UserError(f"{path}, line 1: not text ({error.reason}); give an unpacked text or CSV file.") from error
    if not text:
        raise UserError(f"{path}: the file is empty; a table of text was expected.")
    return text


def reason(error: Exception) -> str:
    """The first line of a library's error message, to be quoted inside one of ours."""
    return (str(error).splitlines() or [type(error).__name__])[0].rstrip(". ")


def convert(text: pl.Series, kind: Kind, path: Path, lines: pl.Series, thousands: bool = False) -> pl.Series:
    """Convert one column of text to ``kind``.

    Args:
        kind: ``String``, ``Int64`` (a whole number; ``3.0`` counts as one) or ``Float64`` (a finite number).
        lines: the line of each row, for messages.
        thousands: whether commas may separate thousands.

    Raises:
        UserError: a field is empty or not what was expected; the first one is named by file, line and column.
    """
    text = text.str.strip_chars()
    raise_where(text.is_null() | (text == ""), text, path, "is empty; the row is incomplete", lines)
    if kind == pl.String:
        return text
    plain = text
    if thousands:
        field = pl.col(text.name)
        # Any other comma stays, so that the field is reported as no number.
        without = pl.when(field.str.contains(_THOUSANDS)).then(field.str.replace_all(",", "", literal=True))
        plain = text.to_frame().select(without.otherwise(field)).to_series()
    numbers = plain.cast(pl.Float64, strict=False)
    raise_where(numbers.is_null(), text, path, "is not a number", lines)
    raise_where(~numbers.is_finite(), text, path, "is not a finite number", lines)
    if kind == pl.Int64:
        raise_where(numbers != numbers.round(), text, path, "is not a whole number", lines)
        raise_where(numbers.abs() >= 2.0**63, text, path, "is too large a number", lines)
    return numbers.cast(kind)


def raise_where(bad: pl.Series, values: pl.Series, path: Path, what: str, lines: pl.Series) -> None:
    """Raise a UserError that names the first row that is ``bad``, if there is one; null is not bad."""
    row = bad.fill_null(False).arg_max() if bad.any() else None
    if row is not None:
        field = "the field" if values[row] in (None, "") else repr(values[row])
        raise UserError(
            f"{path}, line {lines[row]}, column {values.name}: {field} {what}; correct or remove the row."
        )


def read_blocks(
    table: TextTable, wanted: Sequence[str], block_bytes: int = BLOCK_BYTES, on_progress: OnProgress | None = None
) -> Iterator[pl.DataFrame]:
    """The ``wanted`` columns as text, and ``line``, block by block; rows in the order of the file.

    Raises:
        UserError: a row with too many or too few fields or with bytes that are not text, an empty line, or a last
            row that is cut off; the message names file and line.
    """
    number = FIRST_LINE if table.has_header else 1
    done, total = 0, table.path.stat().st_size
    for block, has_no_end in _whole_lines(table, block_bytes):
        place = f"{table.path}, line {number}"
        # A last line without a line break is a row only if it has all its fields.
        if has_no_end and (found := len(_fields(table, block, place))) < len(table.names):
            raise UserError(
                f"{place}, column {table.names[max(found - 1, 0)]}: the file breaks off here, "
                f"{found} of {len(table.names)} columns into the row; copy or download it again."
            )
        rows = block.count(b"\n") + (not block.endswith(b"\n"))
        yield _parse(table, block, wanted, number, rows)
        number += rows
        done += len(block)
        if on_progress is not None:
            on_progress(done, total)


def _whole_lines(table: TextTable, block_bytes: int) -> Iterator[tuple[bytes, bool]]:
    """Blocks of whole lines; true for a last line without a line break. Empty lines at the end are left out."""
    with table.path.open("rb") as file:
        if table.has_header:
            file.readline()
        rest = b""
        while read := file.read(block_bytes):
            together = rest + read
            # The last non-empty line is held back: it may be the file's last.
            cut = together.rstrip().rfind(b"\n") + 1
            if cut:
                yield together[:cut], False
            rest = together[cut:]
        if rest.strip():
            yield rest.rstrip(), not rest.endswith(b"\n")


def _fields(table: TextTable, line: bytes, place: str) -> list[str]:
    text = line.decode("utf-8", errors="replace")
    return text.split() if table.blanks else _cells(text, place)


def _cells(line: str, place: str) -> list[str]:
    try:
        return next(csv.reader([line]), [])
    except csv.Error as error:
        raise UserError(
            f"{place}: not a line of CSV ({reason(error).partition(' - ')[0]}); correct or remove it."
        ) from error


def _parse(table: TextTable, block: bytes, wanted: Sequence[str], number: int, rows: int) -> pl.DataFrame:
    """One block of ``rows`` lines, the first of which is line ``number``."""
    separator = b" " if table.blanks else b","
    if table.blanks:
        block = _single_blanks(block)
    # Columns are named by their position while parsing, since a file may use a name twice.
    columns = [b"c%d" % k for k in range(len(table.names))]
    places = {f"c{table.names.index(name)}": name for name in wanted}
    # The parser does not check columns that it skips, so extra fields are found by counting separators.
    has_quotes = b'"' in block
    if not has_quotes and block.count(separator) != rows * (len(columns) - 1):
        _raise_at_bad_line(table, block, number)
    try:
        frame = pl.read_csv(
            separator.join(columns) + b"\n" + block,
            separator=separator.decode(),
            infer_schema=False,
            columns=None if has_quotes else list(places),
        )
    except (pl.exceptions.PolarsError, UnicodeDecodeError) as error:
        _raise_at_bad_line(table, block, number)
        raise UserError(f"{table.path}, from line {number}: not a readable table ({error}).") from error
    if frame.height != rows:
        _raise_at_bad_line(table, block, number)
        raise UserError(f"{table.path}, from line {number}: a row stretches over several lines.")
    frame = frame.select(pl.col(place).alias(name) for place, name in places.items())
    return frame.with_columns(pl.int_range(number, number + rows, dtype=pl.Int64).alias(LINE))


def _single_blanks(block: bytes) -> bytes:
    """One blank between the fields of each line, none at its ends."""
    block = block.replace(b"\r\n", b"\n").replace(b"\t", b" ")
    while b"  " in block:
        block = block.replace(b"  ", b" ")
    return block.replace(b"\n ", b"\n").replace(b" \n", b"\n").strip(b" ")


def _raise_at_bad_line(table: TextTable, block: bytes, number: int) -> None:
    """Look for the first line that does not fit the table."""
    expected = len(table.names)
    for line, raw in enumerate(block.removesuffix(b"\n").split(b"\n"), number):
        place = f"{table.path}, line {line}"
        if not raw.strip():
            raise UserError(f"{place}: the line is empty; remove it.")
        try:
            raw.decode()
        except UnicodeDecodeError as error:
            raise UserError(f"{place}: the line is not text; copy or download the file again.") from error
        if raw.count(b'"') % 2:
            raise UserError(f"{place}: a quotation mark without its counterpart; correct or remove the row.")
        found = len(_fields(table, raw, place))
        if found > expected:
            raise UserError(f"{place}: {found} fields, expected {expected}; correct or remove the row.")
        if found < expected:
            column = table.names[found - 1]
            raise UserError(
                f"{place}, column {column}: the row ends after {found} of {expected} fields; correct or remove it."
            )
