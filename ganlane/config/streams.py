"""Standard output and error that take no more: the reader has left (``| head``), or the disk behind them is full."""

from __future__ import annotations

import os
import select
import sys
from typing import TextIO


def let_go_of_streams() -> bool:
    """Send nowhere what can no longer be written; whether a reader has left.

    Python would try again when it ends, complain, and end with a status of its own.
    """
    left = [_has_no_reader(stream) for stream in (sys.stdout, sys.stderr)]
    for stream, gone in zip((sys.stdout, sys.stderr), left):
        if gone or not _takes_what_is_left(stream):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)
    return any(left)


def _has_no_reader(stream: TextIO) -> bool:
    """Whether the stream is a pipe that nobody reads; there is no telling on Windows."""
    try:
        looked = select.poll()
        looked.register(stream.fileno(), 0)
    except (AttributeError, OSError):  # no such call, or no file behind the stream, as in a notebook
        return False
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in looked.poll(0))


def _takes_what_is_left(stream: TextIO) -> bool:
    try:
        stream.flush()
    except OSError:
        return False
    return True
