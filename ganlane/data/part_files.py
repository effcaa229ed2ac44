"""A file that has come in part: how much of it is there, and of which version it is."""

from __future__ import annotations

import json
from pathlib import Path

from ganlane.files import write_json


def version_of(part: Path) -> str | None:
    """What the server called the version that the part is of; None where it cannot be gone on with."""
    try:
        version = json.loads(_note(part).read_text())["version"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return version if isinstance(version, str) and not version.startswith("W/") else None


def note_version(part: Path, version: str | None) -> None:
    """Write down what the server called the version."""
    write_json(_note(part), {"version": version})


def _note(part: Path) -> Path:
    return part.with_name(part.name + ".json")


def forget(part: Path) -> None:
    """Remove the part and its note."""
    part.unlink(missing_ok=True)
    _note(part).unlink(missing_ok=True)


def size_of(part: Path) -> int:
    """Bytes there so far."""
    return part.stat().st_size if part.is_file() else 0
