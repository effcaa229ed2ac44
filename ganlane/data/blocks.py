"""Text tables of any size, block by block: whole lines, the columns that are wanted, and the line of every row."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from typing import Final

import polars as pl

from ganlane.data.layout import TextTable
from ganlane.data.source import OnProgress
from ganlane.errors import UserError

#: Bytes read at once: some 300,000 rows, of which the memory takes a few times as much.
BLOCK_BYTES: Final = 32 * 2**20
#: Name of the column that tells each row's line of the file.
LINE: Final = "line"


def read_blocks(
    table: TextTable, wanted: Sequence[str], block_bytes: int = BLOCK_BYTES, on_progress: OnProgress | None = None
) -> Iterator[pl.DataFrame]:
    """The ``wanted`` columns as text, and ``line``, block by block; rows in the order of the file.

    Args:
        table: the layout.
        wanted: names of columns.
        block_bytes: read at once.
        on_progress: called with the bytes read.

    Raises:
        UserError: a row with too many or too few fields or with bytes that are not text, an empty line, or a last
            row that breaks off; the message names file and line.
    """
    number = 2 if table.has_header else 1
    done, total = 0, table.path.stat().st_size
    for block, is_broken_off in _whole_lines(table, block_bytes):
        if is_broken_off:
            _refuse_broken_off(table, block, number)
        rows = block.count(b"\n") + (not block.endswith(b"\n"))
        yield _parse(table, block, wanted, number, rows)
        number += rows
        done += len(block)
        if on_progress is not None:
            on_progress(done, total)


def _whole_lines(table: TextTable, block_bytes: int) -> Iterator[tuple[bytes, bool]]:
    """Blocks of whole lines; true with a last line that no line break ends. Empty lines at the end are left out."""
    with table.path.open("rb") as file:
        if table.has_header:
            file.readline()
        rest = b""
        while read := file.read(block_bytes):
            together = rest + read
            # The last line that is not empty waits: it may be the file's last.
            cut = together.rstrip().rfind(b"\n") + 1
            if cut:
                yield together[:cut], False
            rest = together[cut:]
        if rest.strip():
            yield rest.rstrip(), not rest.endswith(b"\n")


def _refuse_broken_off(table: TextTable, line: bytes, number: int) -> None:
    """A last line without a line break is a row only if it has all its fields."""
    found = len(_fields(table, line))
    if found < len(table.names):
        raise UserError(
            f"{table.path}, line {number}, column {table.names[max(found - 1, 0)]}: the file breaks off here, "
            f"{found} of {len(table.names)} columns into the row; copy or download it again."
        )


def _fields(table: TextTable, line: bytes) -> list[str]:
    text = line.decode("utf-8", errors="replace")
    return text.split() if table.blanks else next(csv.reader([text]), [])


def _parse(table: TextTable, block: bytes, wanted: Sequence[str], number: int, rows: int) -> pl.DataFrame:
    """One block; positions stand in for names, so that a name may come twice."""
    separator = b" " if table.blanks else b","
    columns = [b"c%d" % k for k in range(len(table.names))]
    block = _single_blanks(block) if table.blanks else block
    places = {f"c{table.names.index(name)}": name for name in wanted}
    # Columns that are skipped are not checked by the parser: extra fields would go unseen.
    has_quotes = b'"' in block
    if not has_quotes and block.count(separator) != rows * (len(columns) - 1):
        _refuse_line(table, block, number)
    try:
        frame = pl.read_csv(
            separator.join(columns) + b"\n" + block,
            separator=separator.decode(),
            infer_schema=False,
            columns=None if has_quotes else list(places),
        )
    except (pl.exceptions.PolarsError, UnicodeDecodeError) as error:
        _refuse_line(table, block, number)
        raise UserError(f"{table.path}, from line {number}: not a readable table ({error}).") from error
    if frame.height != rows:
        _refuse_line(table, block, number)
        raise UserError(f"{table.path}, from line {number}: a row stretches over several lines.")
    frame = frame.select(pl.col(place).alias(name) for place, name in places.items())
    return frame.with_columns(pl.int_range(number, number + rows, dtype=pl.Int64).alias(LINE))


def _single_blanks(block: bytes) -> bytes:
    """One blank between the fields of each line, none at its ends."""
    block = block.replace(b"\r\n", b"\n").replace(b"\t", b" ")
    while b"  " in block:
        block = block.replace(b"  ", b" ")
    return block.replace(b"\n ", b"\n").replace(b" \n", b"\n").strip(b" ")


def _refuse_line(table: TextTable, block: bytes, number: int) -> None:
    """Look for the line that does not fit the table."""
    for line, raw in enumerate(block.removesuffix(b"\n").split(b"\n"), number):
        fault = _fault(table, raw)
        if fault:
            raise UserError(f"{table.path}, line {line}{fault}.")


def _fault(table: TextTable, raw: bytes) -> str | None:
    """What is wrong with a line, and what to do."""
    if not raw.strip():
        return ": the line is empty; remove it"
    try:
        raw.decode()
    except UnicodeDecodeError:
        return ": the line is not text; copy or download the file again"
    if raw.count(b'"') % 2:
        return ": a quotation mark without its counterpart; mend or remove the row"
    found, expected = len(_fields(table, raw)), len(table.names)
    if found > expected:
        return f": {found} fields, expected {expected}; mend or remove the row"
    if found < expected:
        return (
            f", column {table.names[found - 1]}: the row ends after {found} of {expected} fields; mend or remove it"
        )
    return None
