"""Errors that a user can correct; the message is one sentence that says what to do.

Errors of the file system become such sentences too: the path, what is wrong, what to do. A refused
connection or a lost process is an OSError that no user can fix: it keeps its traceback.
"""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

#: Exit status after a user's mistake or a failing disk.
USER_ERROR = 2


#: Characters that a terminal obeys instead of showing them.
CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")


def printable(text: str) -> str:
    r"""``text`` with control characters but tabs and line ends as escapes (``\x1b``)."""

    def escaped(match: re.Match[str]) -> str:
        return match[0] if match[0] in "\t\n" else repr(match[0])[1:-1]

    return CONTROL.sub(escaped, text)


class UserError(Exception):
    """Something the user can correct: a config value, a file, a column, a shape or a checkpoint.

    The message names the value, what was expected and what to do. Entry points print it without a
    traceback and exit with status 2.
    """

    def __str__(self) -> str:
        return printable(super().__str__())


class ParameterError(UserError):
    """A parameter out of its range, or parameters that do not fit together.

    The record that raises it knows its fields, not their keys. So the sentence has the fields in
    braces, ``"{timeout_s}=0: expected a number above 0."``, and who knows the key of the record
    puts it before them with :meth:`below`.
    """

    def __str__(self) -> str:
        return printable(_FIELD.sub(r"\1", self.args[0]))

    def below(self, where: str) -> ParameterError:
        """The same error, of the record at the key ``where``."""
        return ParameterError(_FIELD.sub(rf"{{{where}.\1}}", self.args[0]))


#: A field in braces in the text of a :class:`ParameterError`.
_FIELD = re.compile(r"\{([\w.]+)\}")


def did_you_mean(name: str, candidates: Iterable[str]) -> str:
    """A hint such as `` (did you mean 'lanes'?)``; empty where nothing is close."""
    close = difflib.get_close_matches(name, list(candidates), n=1)
    return f" (did you mean '{close[0]}'?)" if close else ""


def as_typed(value: Any) -> str:
    """A config value as typed on the command line: ``true``, ``null``, ``-120``, ``[64,64]``."""
    if isinstance(value, list | tuple):
        return f"[{','.join(map(as_typed, value))}]"
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    # The short form of a float, 0.1 or 1e+06, where it is the same number.
    if isinstance(value, float) and float(f"{value:g}") == value:
        return f"{value:g}"
    return str(value)


def is_users_matter(error: BaseException) -> bool:
    """Whether a user can fix the error: one about a path, a permission or a disk."""
    # These are OSErrors with a number, too.
    others = (ConnectionError, ChildProcessError, ProcessLookupError, TimeoutError)
    if isinstance(error, others):
        return False
    return isinstance(error, OSError) and bool(error.errno)


def file_sentence(error: OSError) -> str:
    """The path, what is wrong, and what to do."""
    where = error.filename2 or error.filename or "a file or standard output"
    reason = error.strerror or os.strerror(error.errno or 0)
    return printable(f"{where}: {reason}; check the path, its permissions and the space there.")


@contextmanager
def numbered_refusals() -> Iterator[None]:
    """Turn errors of the file system that a library reports as text alone into OSErrors with their
    number.

    polars raises "No space left on device (os error 28)" in errors of several types, without number
    or file name.
    """
    try:
        yield
    except Exception as error:
        code = re.search(r"\(os error (\d+)\)", str(error))
        numbered = getattr(error, "errno", None) is not None
        if code is None or numbered or isinstance(error, UserError):
            raise
        number = int(code[1])
        raise OSError(number, os.strerror(number)) from error
