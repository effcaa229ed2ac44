"""What a part of the trial counts, and work in a forked child because it may end there."""

from __future__ import annotations

import multiprocessing
import resource
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

#: A child is a copy of this process, which has imported everything.
FORK = multiprocessing.get_context("fork")


@dataclass
class Tally:
    """Counts of one part: ``what`` by name, and the number of failures."""

    part: str
    what: Counter[str] = field(default_factory=Counter)
    failed: int = 0
    seconds: float = 0.0

    def fail(self, text: str) -> None:
        """Count a failure and print it, with what repeats it."""
        self.failed += 1
        print(f"{self.part}: {text}", flush=True)

    def row(self) -> str:
        """A row of the table, in Markdown."""
        tried = "; ".join(f"{number:,} {name}" for name, number in self.what.items())
        return f"| {self.part} | {tried} | {self.failed} | {self.seconds / 60:.1f} |"


def forked(
    work: Callable[[Any], Any], items: Iterable[Any], at_most_s: float, memory_gib: float = 8.0
) -> Iterator[tuple[Any, Any]]:
    """``(item, work(item))`` for every item, in children; a child that is lost is replaced.

    Where the child ended, or took longer than ``at_most_s``, the result begins with ``LOST``.
    """
    waiting = list(items)
    while waiting:
        results, sender = FORK.Pipe(duplex=False)
        memory = int(memory_gib * 2**30)
        child = FORK.Process(target=_serve, args=(work, waiting, sender, memory))
        child.start()
        sender.close()
        lost = ""
        try:
            while waiting and not lost:
                try:
                    if results.poll(at_most_s):
                        result = results.recv()
                        yield waiting.pop(0), result
                    else:
                        lost = f"LOST: more than {at_most_s:g} s"
                except EOFError:
                    lost = "LOST: the process ended"
        finally:  # also where the caller has had enough
            child.kill()
            child.join()
        if lost:
            yield waiting.pop(0), f"{lost} (status {child.exitcode})"


def _serve(work: Callable[[Any], Any], items: list[Any], sender: Connection, memory: int) -> None:
    """Do the work and send the results, then wait for the end of this process."""
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    for item in items:
        sender.send(work(item))
    time.sleep(1e6)  # the parent ends it, once it has read everything
