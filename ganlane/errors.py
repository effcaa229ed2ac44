"""Errors that a user can correct; the message is one sentence that says what to do."""

from __future__ import annotations

import re
from typing import Any


class UserError(Exception):
    """Something the user can correct: a config value, a file, a column, a shape or a checkpoint.

    The message names the value, what was expected and what to do. Entry points print it without a traceback and exit
    with status 2.
    """


class ParameterError(UserError):
    """A parameter out of its range, or incompatible parameters.

    The record that raises it knows its fields, not their keys. So the sentence has the fields in braces,
    ``"{timeout_s}=0: expected a number above 0."``, and a caller that knows the key adds it with :meth:`below`.

    Args:
        text: the sentence.
        where: key of the record, for instance ``env.idm``; empty: fields without prefix.
    """

    def __init__(self, text: str, where: str = "") -> None:
        super().__init__(text, where)
        self.text, self.where = text, where

    def __str__(self) -> str:
        place = f"{self.where}." if self.where else ""
        return re.sub(r"\{([\w.]+)\}", rf"{place}\1", self.text)

    def below(self, where: str) -> ParameterError:
        """The same error with the record's key."""
        return ParameterError(self.text, where)


def as_typed(value: Any) -> str:
    """A config value as typed on the command line: ``true``, ``null``, ``-120``, ``[64,64]``."""
    if isinstance(value, list | tuple):
        return f"[{','.join(map(as_typed, value))}]"
    if value is None or isinstance(value, bool):
        return "null" if value is None else str(value).lower()
    exact = isinstance(value, float) and float(f"{value:g}") == value  # the short form is the same number
    return f"{value:g}" if exact else str(value)
