"""Shared by the scripts: command line, numbers and tables as documents show them, the part of a
document that one writes, exit status.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import torch

from ganlane.errors import UserError
from ganlane.evaluation.table import Table
from ganlane.files import write_bytes


def make_parser(description: str | None) -> argparse.ArgumentParser:
    """A command line whose help begins with ``description``, the docstring of the script."""
    return argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def add_report(parser: argparse.ArgumentParser, begin: str, end: str) -> None:
    """Offer ``--report``, the document for a :class:`ReportSection` between these markers."""
    parser.add_argument("--report", type=Path, help=f"a document with the lines {begin} and {end}")


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
    # Rounded first: 9.996 has three digits as 10.0, not as 10.00.
    rounded = float(f"{value:.3g}")
    # Digits before the point; below 1 the format counts them itself.
    whole = len(str(int(abs(rounded))))
    return f"{rounded:.{max(0, 3 - whole)}f}" if abs(rounded) >= 1 else f"{rounded:.3g}"


def count(value: float) -> str:
    """Three significant digits, with k, M and G: ``612``, ``54.3 k``, ``1.23 M``."""
    for limit, unit in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        # What rounds up to the next unit is given in that unit: 1.00 M, not 1000 k.
        if abs(value) >= limit * 0.9995:
            return f"{significant(value / limit)}{unit}"
    return significant(value)


def split_at_markers(path: Path, begin: str, end: str) -> tuple[str, str, str]:
    """The text of a document up to the marker ``begin``, between the two, and from ``end`` on.

    Raises:
        UserError: there is no such file, or it does not hold the two markers once each and in
            order.
    """
    if not path.is_file():
        raise UserError(
            f"report={path}: no such file; expected a document with the lines {begin} and {end} in "
            "it."
        )
    text = path.read_text(encoding="utf-8")
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
        raise UserError(
            f"report={path}: expected the lines {begin} and {end} in it, once each; add them."
        )
    before, _, rest = text.partition(begin)
    between, _, after = rest.partition(end)
    return before + begin, between, end + after


class ReportSection:
    """The part of a document that a script writes, between two markers.

    Made before anything is measured, so that a document without the markers is refused at once, not
    hours later.

    Args:
        document: as ``--report`` gives it; None: nothing is written anywhere.
        begin, end: the markers.

    Raises:
        UserError: see :func:`split_at_markers`.
    """

    def __init__(self, document: Path | None, begin: str, end: str) -> None:
        self.document = document
        self.markers = begin, end
        if document is not None:
            split_at_markers(document, begin, end)

    def read(self) -> str:
        """What stands between the markers now; without a document nothing."""
        if self.document is None:
            return ""
        return split_at_markers(self.document, *self.markers)[1].strip()

    def write(self, content: str) -> None:
        """Put ``content`` between the markers, on lines of its own."""
        if self.document is not None:
            before, _, after = split_at_markers(self.document, *self.markers)
            write_bytes(self.document, f"{before}\n{content}\n{after}".encode())


def run_script(measure: Callable[[argparse.Namespace], str], arguments: argparse.Namespace) -> int:
    """Measure on one thread and print the result; the exit status, 2 for a user's mistake."""
    torch.set_num_threads(1)
    try:
        print(measure(arguments))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0
