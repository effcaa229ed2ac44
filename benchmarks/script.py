"""Shared by the scripts: command line, numbers and tables as documents show them, the part of a
document that one writes, exit status.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from ganlane.errors import UserError
from ganlane.evaluation.table import Table
from ganlane.files import write_bytes

#: Of the repository.
ROOT = Path(__file__).parents[1]


def make_parser(description: str | None) -> argparse.ArgumentParser:
    """A command line whose help begins with ``description``, the docstring of the script."""
    return argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def add_report(parser: argparse.ArgumentParser, name: str) -> None:
    """Offer ``--report``, the document for a :class:`ReportSection` of this ``name``."""
    told = f"a document with the lines <!-- begin {name} --> and <!-- end {name} -->"
    parser.add_argument("--report", type=Path, help=told)


def markdown(table: Table) -> str:
    """A title as a heading, the table, and the notes below."""
    rulers = ["---"] * table.names + ["---:"] * (len(table.headings) - table.names)
    rows = [table.headings, rulers, *table.lines]
    parts = [f"### {table.title}"] if table.title else []
    parts.append("\n".join("| " + " | ".join(row) + " |" for row in rows))
    if table.notes:
        parts.append("\n".join(table.notes))
    return "\n\n".join(parts)


def significant(value: float | None) -> str:
    """Three significant digits, without exponent."""
    if value is None:
        return "-"
    shown = np.format_float_positional(value, 3, unique=False, fractional=False)
    # Of 612 it leaves the point.
    return shown.rstrip(".")


def count(value: float) -> str:
    """Three significant digits, with k, M and G: ``612``, ``54.3 k``, ``1.23 M``."""
    for limit, unit in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        # What rounds up to the next unit is given in that unit: 1.00 M, not 1000 k.
        if abs(value) >= limit * 0.9995:
            return f"{significant(value / limit)}{unit}"
    return significant(value)


class ReportSection:
    """The part of a document that a script writes: between the lines ``<!-- begin NAME -->`` and
    ``<!-- end NAME -->``.

    Made before anything is measured, so that a document without the lines is refused at once, not
    hours later.

    Args:
        document: as ``--report`` gives it; None: nothing is written anywhere.
        name: of the part.

    Raises:
        UserError: there is no such document, or it does not hold the two lines once each and in
            order.
    """

    def __init__(self, document: Path | None, name: str) -> None:
        self.document = document
        self.name = name
        self.read()

    def read(self) -> str:
        """What stands there now; without a document nothing."""
        return "" if self.document is None else self._split(self.document)[1].strip()

    def write(self, content: str) -> None:
        """Put ``content`` there, with an empty line before and after it."""
        if self.document is not None:
            before, _, after = self._split(self.document)
            write_bytes(self.document, f"{before}\n\n{content}\n\n{after}".encode())

    def _split(self, document: Path) -> tuple[str, str, str]:
        """The text of a document up to the first line, between the two, and from the second on."""
        begin, end = (f"<!-- {side} {self.name} -->" for side in ("begin", "end"))
        if not document.is_file():
            raise UserError(
                f"report={document}: no such file; expected a document with the lines {begin} and "
                f"{end} in it."
            )
        text = document.read_text(encoding="utf-8")
        parts = re.split(f"({begin}|{end})", text)
        if parts[1::2] != [begin, end]:
            raise UserError(
                f"report={document}: expected the lines {begin} and {end} in it, once each; add "
                "them."
            )
        before, _, between, _, after = parts
        return before + begin, between, end + after


def run_script(measure: Callable[[argparse.Namespace], str], arguments: argparse.Namespace) -> int:
    """Measure on one thread and print the result; the exit status, 2 for a user's mistake."""
    torch.set_num_threads(1)
    try:
        print(measure(arguments))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0
