"""How a text table is laid out: its columns, and what parts them."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ganlane.data.tables import Kind, refuse_missing
from ganlane.errors import UserError


@dataclass(frozen=True)
class TextTable:
    """How a text table is laid out.

    Attributes:
        path: the file.
        names: of its columns, in lower case, in order.
        has_header: whether line 1 holds the names.
        blanks: whether runs of blanks part the columns, rather than a comma.
    """

    path: Path
    names: tuple[str, ...]
    has_header: bool = True
    blanks: bool = False


def csv_table(path: str | Path, wanted: Mapping[str, Kind]) -> TextTable:
    """A CSV file by its header line; names are compared in lower case.

    Raises:
        UserError: no such file, an empty one, or one without a ``wanted`` column.
    """
    path = Path(path)
    names = next(csv.reader([first_line(path)]), [])
    found = [name.strip().lower() for name in names]
    refuse_missing(wanted, found, path)
    return TextTable(path, tuple(found))


def first_line(path: Path) -> str:
    """The first line of a text file, without a byte order mark.

    Raises:
        UserError: no such file, or an empty one, or no text.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file; give the path of a text table.")
    with path.open("rb") as file:
        raw = file.readline(2**16)
    if not raw.strip():
        raise UserError(f"{path}: the file is empty; a table of text was expected.")
    try:
        return raw.decode("utf-8-sig").strip()
    except UnicodeDecodeError as error:
        raise UserError(f"{path}, line 1: not text ({error.reason}); give an unpacked text or CSV file.") from error
