"""Shared by the scripts: command line, the part of a document that one writes, exit status."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import torch

from ganlane.errors import UserError
from ganlane.files import split_at_markers, write_between_markers


def make_parser(description: str | None) -> argparse.ArgumentParser:
    """A command line whose help begins with ``description``, the docstring of the script."""
    return argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def add_report(parser: argparse.ArgumentParser, begin: str, end: str) -> None:
    """Offer ``--report``, the document for a :class:`ReportSection` between these markers."""
    parser.add_argument("--report", type=Path, help=f"a document with the lines {begin} and {end}")


class ReportSection:
    """The part of a document that a script writes, between two markers.

    Made before anything is measured, so that a document without the markers is refused at once, not
    hours later.

    Args:
        document: as ``--report`` gives it; None: nothing is written anywhere.
        begin, end: the markers.

    Raises:
        UserError: see :func:`ganlane.files.split_at_markers`.
    """

    def __init__(self, document: Path | None, begin: str, end: str) -> None:
        self.document, self.markers = document, (begin, end)
        if document is not None:
            split_at_markers(document, begin, end)

    def write(self, content: str) -> None:
        """Put ``content`` between the markers."""
        if self.document is not None:
            write_between_markers(self.document, *self.markers, content)


def run_script(measure: Callable[[argparse.Namespace], str], arguments: argparse.Namespace) -> int:
    """Measure on one thread and print the result; the exit status, 2 for a user's mistake."""
    torch.set_num_threads(1)
    try:
        print(measure(arguments))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0
