"""Workers that outlive a Ctrl-C: the main process decides when they end."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker

_ASKING = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def shielded_children() -> Iterator[None]:
    """Processes started in here never see SIGINT and SIGTERM, and the handlers are afterwards what they were.

    A terminal sends Ctrl-C to all processes of a command, and so do Slurm and container runtimes with SIGTERM: a
    worker would die in the middle of the step that the main process still waits for. A child inherits what is
    blocked. Whatever arrives meanwhile reaches this process at the end. Libraries that set handlers of their own
    (``ray.init`` does) would take those of the training loop away.
    """
    handlers = {number: signal.getsignal(number) for number in _ASKING}
    if hasattr(signal, "pthread_sigmask"):
        # Started by the first child otherwise, it would unblock the signals for all that follow.
        resource_tracker.ensure_running()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, _ASKING)
    try:
        yield
    finally:
        for number, handler in handlers.items():
            if signal.getsignal(number) != handler:
                signal.signal(number, handler)
        if hasattr(signal, "pthread_sigmask"):
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
