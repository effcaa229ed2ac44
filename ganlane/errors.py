"""A user's mistake, told in one sentence that says what to do."""

from __future__ import annotations


class UserError(Exception):
    """Something the user can mend: a config value, a file, a column, a shape or a checkpoint.

    The message names the value, what was expected and what to do. Entry points print it alone, without a
    traceback, and exit with status 2 (design: 'Errors').
    """
