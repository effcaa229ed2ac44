"""Ctrl-C and SIGTERM: the loop finishes its step, saves and returns; its workers never see them."""

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

    A second Ctrl-C raises KeyboardInterrupt as usual. Outside the main thread, where Python allows no handlers,
    nothing is changed.
    """

    def __init__(self) -> None:
        #: The number of the signal that came, or None.
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
    """Processes started in here never see SIGINT and SIGTERM, and the handlers are afterwards what they were.

    A terminal sends Ctrl-C to all processes of a command, and so do Slurm and container runtimes with SIGTERM: a
    worker would die in the middle of the step that the main process still waits for. A child inherits what is
    blocked. Whatever arrives meanwhile reaches this process at the end. Libraries that set handlers of their own
    (``ray.init`` does) would take those of the training loop away.
    """
    handlers = {number: signal.getsignal(number) for number in _STOPPING}
    can_block = hasattr(signal, "pthread_sigmask")
    if can_block:
        # Started by the first child otherwise, it would unblock the signals for all that follow.
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
