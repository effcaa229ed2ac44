"""The card in a document: between two markers, rewritten by the command that measures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ganlane.evaluation.provenance import code_version, machine
from ganlane.evaluation.realism.table import checks_text, long_table, quantities_table, starts_table
from ganlane.files import split_at_markers, write_between_markers


def markers(card: str) -> tuple[str, str]:
    """The lines between which a card stands; it is named by its traffic and its starts."""
    return f"<!-- begin realism {card} -->", f"<!-- end realism {card} -->"


def require_markers(path: Path, card: str) -> tuple[str, str]:
    """The document's text before and after a card's tables (:func:`ganlane.files.split_at_markers`)."""
    return split_at_markers(path, *markers(card))


def update_document(path: Path, card: str, content: str) -> None:
    """Put ``content`` between the markers of a card, atomically; the rest stays as it is."""
    write_between_markers(path, *markers(card), f"\n{content}\n")


def card_text(numbers: Mapping[str, Any], long_runs: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[str]:
    """The card's tables, as they are printed.

    Args:
        numbers: what ``results.json`` holds.
        long_runs: by traffic; those that drove none are left out.
    """
    traffic = numbers["traffic"]
    tables = [quantities_table(numbers["quantities"], traffic)]
    if numbers["quantities_held_out"] is not None:
        tables.append(f"held-out scenes alone\n{quantities_table(numbers['quantities_held_out'], traffic)}")
    tables.append(starts_table(numbers["driving"]))
    tables += [f"I-80, {name}\n{quantities_table(rows, traffic)}" for name, rows in numbers["i80"].items()]
    tables += [long_table(runs, name) for name, runs in long_runs.items() if runs]
    return [*tables, checks_text(numbers["checks"])]


def document_text(tables: Sequence[str], numbers: Mapping[str, Any], command: str, written: str) -> str:
    """What :func:`update_document` puts between the markers: command, machine, starts, tables."""
    here, code = machine(), code_version()
    revision = f" ({code['revision'][:12]}{', modified' if code['modified'] else ''})" if code["revision"] else ""
    excess = ", ".join(f"{name} {value:g}" for name, value in numbers["desired_above_mps"].items())
    said = [
        f"Written by the command on {written}:\n\n    {command}",
        f"Taken with Python {here['python']}, torch {here['torch']}, ganlane {code['version']}{revision}, from "
        f"{numbers['starts']} starts: {', '.join(numbers['scenes']) or 'none recorded'}. Desired speeds above the "
        f"speed at entry, mean, m/s: {excess or 'not fitted'}.",
    ]
    return "\n\n".join([*said, *(f"```text\n{table}\n```" for table in tables)])
