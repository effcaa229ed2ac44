"""Ctrl-C and SIGTERM: the loop finishes its step, saves and returns; worker processes ignore them."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from types import FrameType
from typing import Any

_STOPPING = (signal.SIGINT, signal.SIGTERM)


class StopRequest:
    """Context in which SIGINT and SIGTERM set :attr:`signal` instead of ending the process.

    A second Ctrl-C raises KeyboardInterrupt as usual. Outside the main thread, where Python allows no handlers, the
    context does nothing.
    """

    def __init__(self) -> None:
        #: Number of the signal received, or None.
        self.signal: int | None = None
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            self._previous = {number: signal.signal(number, self._handle) for number in _STOPPING}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.signal is not None and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.signal = number


@contextmanager
def shielded_children() -> Iterator[None]:
    """Context whose child processes never receive SIGINT and SIGTERM; signal handlers are restored at its end.

    A terminal sends Ctrl-C to all processes of a command, as Slurm and container runtimes do with SIGTERM: a worker
    would die in the middle of a step that the main process waits for. Children inherit the blocked signals; signals
    that arrive meanwhile are delivered to this process at the end. The handlers are restored because some libraries
    (``ray.init``) replace those of the training loop.
    """
    handlers = {number: signal.getsignal(number) for number in _STOPPING}
    can_block = hasattr(signal, "pthread_sigmask")
    if can_block:
        # Started by the first child, it would unblock the signals for all later children.
        resource_tracker.ensure_running()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, _STOPPING)
    try:
        yield
    finally:
        for number, handler in handlers.items():
            if signal.getsignal(number) != handler:
                signal.signal(number, handler)
        if can_block:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
