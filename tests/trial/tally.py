"""What a part of the trial counts, and work in a forked child because it may end there."""

from __future__ import annotations

import os
import pickle
import resource
import select
import signal
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any


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
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(reading)
            _serve(work, waiting, writing, int(memory_gib * 2**30))
        os.close(writing)
        done = 0
        lost = ""
        try:
            with os.fdopen(reading, "rb") as results:
                while done < len(waiting) and not lost:
                    if not select.select([results], [], [], at_most_s)[0]:
                        lost = f"LOST: more than {at_most_s:g} s"
                        continue
                    try:
                        result = pickle.load(results)  # our own child's
                    except EOFError:
                        lost = "LOST: the process ended"
                        continue
                    yield waiting[done], result
                    done += 1
        finally:  # also where the caller has had enough
            os.kill(child, signal.SIGKILL)
            _, status = os.waitpid(child, 0)
        if lost:
            yield waiting[done], f"{lost} (status {status})"
            done += 1
        waiting = waiting[done:]


def _serve(work: Callable[[Any], Any], items: list[Any], writing: int, memory: int) -> None:
    """Do the work and write the results, then end this process."""
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    try:
        # Unbuffered, and one write for each result: what select sees is all there is.
        for item in items:
            os.write(writing, pickle.dumps(work(item)))
        time.sleep(1e6)  # the parent ends it, once it has read everything
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(1)
