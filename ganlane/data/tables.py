"""Text tables, read block by block, with every error traced to its line and column."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import polars as pl

from ganlane.errors import UserError
from ganlane.settings.generator import BLOCK_BYTES

#: Column that holds each row's line number in the file.
LINE = "line"
#: Line of the first row of data below a header, which is line 1.
FIRST_LINE = 2
#: ``1,118,846,980,200``: commas that separate thousands, unlike a decimal comma.
_THOUSANDS = r"^[+-]?\d{1,3}(,\d{3})+(\.\d*)?$"
#: Type of a column.
Kind = pl.DataType | type[pl.DataType]
#: Called with the bytes done so far and the total, None where the total is unknown.
OnProgress = Callable[[int, int | None], None]


@dataclass(frozen=True)
class TextTable:
    """Layout of a text table.

    Attributes:
        path: the file.
        names: those of its columns, in lower case.
        blanks: runs of blanks separate the columns, not commas, and there is no header.
    """

    path: Path
    names: tuple[str, ...]
    blanks: bool = False


def read_table(path: str | Path, columns: Mapping[str, Kind]) -> pl.DataFrame:
    """The named ``columns`` of a CSV file and ``line``, in the order of the file.

    Raises:
        UserError: no such file, no text table, no rows, a missing column or a wrong field; the
            message names file, line and column.
    """
    path = Path(path)
    texts = read_blocks(csv_table(path, columns), list(columns))
    blocks = [converted(text, columns, path) for text in texts]
    if not blocks:
        raise UserError(f"{path}: a header but no rows; give a file with at least one row of data.")
    return pl.concat(blocks)


def csv_table(path: Path, wanted: Iterable[str]) -> TextTable:
    """Layout of a CSV file from its header, which must hold the ``wanted`` columns in any case.

    Raises:
        UserError: no such file, no text table, or a missing column.
    """
    # Names in any case, with blanks around them.
    header = _fields(first_line(path), f"{path}, line 1")
    names = tuple(name.strip().lower() for name in header)
    missing = [name for name in wanted if name not in names]
    if missing:
        raise UserError(
            f"{path}, line 1: no column {', '.join(missing)}; found {', '.join(names)}; "
            f"expected {', '.join(wanted)}."
        )
    return TextTable(path, names)


def first_line(path: Path) -> str:
    """The first line of a text file, without a byte order mark.

    Raises:
        UserError: no such file, or an empty one, or no text.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file; give the path of a text table.")
    with path.open("rb") as file:
        # A binary file may have no line break at all.
        raw = file.readline(2**16)
    try:
        text = raw.decode("utf-8-sig").strip()
    except UnicodeDecodeError as error:
        raise UserError(
            f"{path}, line 1: not text ({error.reason}); give an unpacked text or CSV file."
        ) from error
    if not text:
        raise UserError(f"{path}: the file is empty; a table of text was expected.")
    return text


def reason(error: Exception) -> str:
    """The first line of a library's error message, to be quoted inside one of ours."""
    # An error without a message says by its type what it is.
    lines = str(error).splitlines() or [type(error).__name__]
    return lines[0].rstrip(". ")


def converted(text: pl.DataFrame, columns: Mapping[str, Kind], path: Path) -> pl.DataFrame:
    """The ``columns`` of a block of text in their types, and ``line``; see :func:`convert`."""
    series = [convert(text, name, kind, path) for name, kind in columns.items()]
    return pl.DataFrame([*series, text[LINE]])


def convert(text: pl.DataFrame, column: str, kind: Kind, path: Path) -> pl.Series:
    """A ``column`` of text as ``String``, ``Int64`` (also of ``3.0``) or finite ``Float64``.

    Commas may separate thousands, as in NGSIM's portal.

    Raises:
        UserError: a field is empty or not what was expected; the first one is named by file, line
            and column.
    """
    text = text.select(pl.col(column).str.strip_chars(), LINE)
    field = text[column]
    refuse = partial(raise_where, rows=text, column=column, path=path)
    refuse(field.is_null() | (field == ""), what="is empty; the row is incomplete")
    if kind == pl.String:
        return field

    # Any other comma stays, so that the field is reported as no number.
    has_thousands = field.str.contains(_THOUSANDS)
    without = field.str.replace_all(",", "", literal=True)
    field = without.zip_with(has_thousands, field)
    # Through floats, since whole numbers may be written as 3.0.
    numbers = field.cast(pl.Float64, strict=False)
    refuse(numbers.is_null(), what="is not a number")
    refuse(~numbers.is_finite(), what="is not a finite number")
    if kind == pl.Int64:
        refuse(numbers != numbers.round(), what="is not a whole number")
        refuse(numbers.abs() >= 2.0**63, what="is too large a number")
    return numbers.cast(kind)


def raise_where(
    bad: pl.Series,
    rows: pl.DataFrame,
    column: str,
    path: Path,
    what: str,
) -> None:
    """Raise a UserError that names the first of the ``rows`` that is ``bad``.

    Args:
        bad: flags [R] of the rows; null is not bad.
        rows: of the file ``path``, with :data:`LINE`.
        column: the one to name.
        path: the file.
        what: what is wrong with its field, as "is not a number".
    """
    if not bad.any():
        return
    first = bad.fill_null(False).arg_max()
    row = rows.row(first, named=True)  # type: ignore[arg-type]
    field = "the field" if row[column] in (None, "") else repr(row[column])
    raise UserError(
        f"{path}, line {row[LINE]}, column {column}: {field} {what}; correct or remove the row."
    )


def raise_unless_positive(rows: pl.DataFrame, columns: Sequence[str], path: Path) -> None:
    """Raise a UserError that names the first of the ``rows`` with 0 or less in a column."""
    for column in columns:
        raise_where(rows[column] <= 0.0, rows, column, path, "is not above 0")


def read_blocks(
    table: TextTable,
    wanted: Sequence[str],
    block_bytes: int = BLOCK_BYTES,
    on_progress: OnProgress | None = None,
) -> Iterator[pl.DataFrame]:
    """The ``wanted`` columns as text, and ``line``, block by block in the order of the file.

    Args:
        table: layout of the file.
        wanted: names of columns.
        block_bytes: about so many bytes of the file are in memory at a time.
        on_progress: called after each block.

    Raises:
        UserError: a row that does not fit, is not text, empty or cut off; the message names file
            and line.
    """
    number = 1 if table.blanks else FIRST_LINE
    done = 0
    total = table.path.stat().st_size
    for block in _whole_lines(table, block_bytes):
        # The last line of the file may have no line break.
        rows = block.count(b"\n") + (not block.endswith(b"\n"))
        lines = pl.int_range(number, number + rows, dtype=pl.Int64).alias(LINE)
        yield _parse(table, block, number, rows, wanted).with_columns(lines)

        number += rows
        done += len(block)
        if on_progress is not None:
            on_progress(done, total)


def _whole_lines(table: TextTable, block_bytes: int) -> Iterator[bytes]:
    """Blocks of whole lines; the last line may have no line break.

    Empty lines at the end are left out.
    """
    with table.path.open("rb") as file:
        # The header.
        if not table.blanks:
            file.readline()
        rest = b""
        while read := file.read(block_bytes):
            # Blocks end anywhere; lines do not.
            together = rest + read
            # The last non-empty line is held back: it may be the file's last.
            cut = together.rstrip().rfind(b"\n") + 1
            if cut:
                yield together[:cut]
            rest = together[cut:]
        if rest.strip():
            yield rest.rstrip() + (b"\n" if rest.endswith(b"\n") else b"")


def _fields(line: str, place: str, blanks: bool = False) -> list[str]:
    """The fields of one line, which stands at ``place`` (file and number)."""
    if blanks:
        return line.split()
    try:
        return next(csv.reader([line]), [])
    except csv.Error as error:
        # What follows the dash is for programmers.
        what = reason(error).partition(" - ")[0]
        raise UserError(f"{place}: not a line of CSV ({what}); correct or remove it.") from error


def _parse(
    table: TextTable,
    block: bytes,
    number: int,
    rows: int,
    wanted: Sequence[str],
) -> pl.DataFrame:
    """The ``wanted`` columns of a block of ``rows`` lines, the first of which is ``number``."""
    separator = " " if table.blanks else ","
    if table.blanks:
        # A single blank between two fields, which is all that the parser knows.
        block = b"\n".join(b" ".join(line.split()) for line in block.split(b"\n"))
    # The parser fills short rows with nulls, so they are found by counting separators.
    # Quoted fields may hold separators, so the count says nothing there.
    expected = rows * (len(table.names) - 1)
    if b'"' not in block and block.count(separator.encode()) != expected:
        _check_lines(table, block, number)

    # Columns are named by their position, since a file may use a name twice.
    places = [f"column_{index}" for index in range(len(table.names))]
    try:
        frame = pl.read_csv(
            block,
            separator=separator,
            has_header=False,
            schema=dict.fromkeys(places, pl.String()),
        )
    except (pl.exceptions.PolarsError, UnicodeDecodeError) as error:
        _check_lines(table, block, number)
        raise UserError(
            f"{table.path}, from line {number}: not a readable table ({error})."
        ) from error
    # A quoted line break would shift all line numbers below it.
    if frame.height != rows:
        _check_lines(table, block, number)
        raise UserError(f"{table.path}, from line {number}: a row stretches over several lines.")

    columns = []
    for name in wanted:
        # The first of several columns of one name.
        place = places[table.names.index(name)]
        columns.append(pl.col(place).alias(name))
    return frame.select(columns)


def _check_lines(table: TextTable, block: bytes, number: int) -> None:
    """Raise a UserError that names the first line of a block that does not fit the table.

    Nothing happens where all lines fit.
    """
    expected = len(table.names)
    lines = block.removesuffix(b"\n").split(b"\n")
    for line, raw in enumerate(lines, number):
        place = f"{table.path}, line {line}"
        if not raw.strip():
            raise UserError(f"{place}: the line is empty; remove it.")
        try:
            text = raw.decode()
        except UnicodeDecodeError as error:
            raise UserError(
                f"{place}: the line is not text; copy or download the file again."
            ) from error

        fields = len(_fields(text, place, table.blanks))
        if raw.count(b'"') % 2:
            raise UserError(
                f"{place}: a quotation mark without its counterpart; correct or remove the row."
            )
        if fields != expected:
            # The last column that the row still has.
            column = table.names[max(min(fields, expected) - 1, 0)]
            raise UserError(
                f"{place}, column {column}: the row has {fields} fields, expected {expected}; "
                "correct or remove it, or copy the file again if it breaks off here."
            )
