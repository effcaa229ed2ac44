"""A user's mistake, told in one sentence that says what to do."""

from __future__ import annotations

from typing import Any


class UserError(Exception):
    """Something the user can mend: a config value, a file, a column, a shape or a checkpoint.

    The message names the value, what was expected and what to do. Entry points print it alone, without a
    traceback, and exit with status 2 (design: 'Errors').
    """


def as_typed(value: Any) -> str:
    """A config value as one types it on the command line: ``true``, ``null``, ``-120``, ``[64,64]``."""
    if isinstance(value, list | tuple):
        return f"[{','.join(map(as_typed, value))}]"
    if value is None or isinstance(value, bool):
        return "null" if value is None else str(value).lower()
    # The short form of a number, where it is the same number.
    short = isinstance(value, float) and float(f"{value:g}") == value
    return f"{value:g}" if short else str(value)
