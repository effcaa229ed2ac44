"""A suite's result for a reader: on the terminal, and between two markers of a document."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ganlane.benchmarks.case import Suite
from ganlane.evaluation import code_version, machine
from ganlane.files import split_at_markers, write_between_markers


def markers(suite: str) -> tuple[str, str]:
    """The lines between which a suite's tables stand in a document."""
    return f"<!-- begin bench {suite} -->", f"<!-- end bench {suite} -->"


def require_markers(path: Path, suite: str) -> tuple[str, str]:
    """The document's text before and after a suite's tables (:func:`ganlane.files.split_at_markers`)."""
    return split_at_markers(path, *markers(suite))


def update_document(path: Path, suite: str, content: str) -> None:
    """Put ``content`` between the markers of a suite, atomically; the rest stays as it is."""
    write_between_markers(path, *markers(suite), content)


def machine_sentence(threads: Sequence[int]) -> str:
    """Where and on which code the figures were taken, without host names or paths."""
    here, code = machine(), code_version()
    usable = f"{here['cores']} usable core{'s' if here['cores'] != 1 else ''}"
    accelerator = f", {here['accelerator']}" if here["accelerator"] else ""
    revision = f" ({code['revision'][:12]}{', modified' if code['modified'] else ''})" if code["revision"] else ""
    return (
        f"{here['cpu']}, {usable}{accelerator}; Python {here['python']}, torch {here['torch']} (threads: "
        f"{', '.join(map(str, threads))}); ganlane {code['version']}{revision}."
    )


def report_sections(
    suite: Suite, numbers: Mapping[str, Any], command_line: str, threads: Sequence[int], written: str
) -> str:
    """What :func:`update_document` puts between the markers: command, machine, tables, and what was left out."""
    tables = suite.tables(numbers["rows"], numbers)
    parts = [
        f"Written by the command on {written}:\n\n    {command_line}",
        f"Taken on: {machine_sentence(threads)}",
        *[table.markdown() for table in tables],
    ]
    if numbers["notes"]:
        parts.append("\n".join(f"- {note}" for note in numbers["notes"]))
    return "\n" + "\n\n".join(parts) + "\n"


def print_report(suite: Suite, numbers: Mapping[str, Any]) -> None:
    """The tables and the notes on stdout."""
    for table in suite.tables(numbers["rows"], numbers):
        print(table.text(), end="\n\n")
    for note in numbers["notes"]:
        print(note)
