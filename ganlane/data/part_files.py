"""What stands beside a file or folder until it is whole: how much is there, of which version, what errors name."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
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


@contextmanager
def named(path: Path, nameless: bool = False) -> Iterator[None]:
    """Let the file system's errors name ``path``, which the user gave, rather than a part ``.NAME....`` beside it.

    Args:
        path: what is being made.
        nameless: errors that name nothing, as those of a write, are about ``path`` too.

    Raises:
        OSError: as it came, with its ``errno``.
    """
    try:
        yield
    except OSError as error:
        known = path if nameless and error.filename is None else _known(error.filename, path)
        if known is None or error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(known)) from error


def _known(told: str | None, path: Path) -> Path | None:
    """``path``, or what is in it, for what an error told of the part; None where it told of something else."""
    if not isinstance(told, str):
        return None
    place, full = Path(os.path.abspath(path)).parent, Path(os.path.abspath(told))
    hidden, *inside = full.relative_to(place).parts if full.is_relative_to(place) and full != place else ("",)
    return path.joinpath(*inside) if hidden.startswith(f".{path.name}.") else None
