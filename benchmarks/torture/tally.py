"""What a part of the trial counts, and the work that is done in a forked child because it may end
there.
"""

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

#: Failures of which the text is kept; all are counted.
KEPT = 50


@dataclass
class Tally:
    """Counts of one part of the trial.

    Attributes:
        part: its name.
        what: counts by name, in the order in which they were first counted.
        detail: further counts, for the JSON alone.
        failures: the first :data:`KEPT` failures in words, each with what repeats it.
        failed: all failures.
    """

    part: str
    what: Counter[str] = field(default_factory=Counter)
    detail: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)
    failed: int = 0
    seconds: float = 0.0

    def fail(self, text: str) -> None:
        """Count a failure."""
        self.failed += 1
        if len(self.failures) < KEPT:
            self.failures.append(text)
        print(f"{self.part}: {text}", flush=True)

    def row(self) -> str:
        """A row of the table, in Markdown."""
        tried = "; ".join(f"{number:,} {name}" for name, number in self.what.items())
        return f"| {self.part} | {tried} | {self.failed} | {self.seconds / 60:.1f} |"

    def plain(self) -> dict[str, Any]:
        """All of it as plain data."""
        counts = {
            "counts": dict(self.what),
            "detail": dict(self.detail),
            "failed": self.failed,
            "failures": self.failures,
        }
        return {"part": self.part, **counts, "minutes": round(self.seconds / 60, 2)}


def forked(
    work: Callable[[Any], Any], items: Iterable[Any], at_most_s: float, memory_gib: float = 8.0
) -> Iterator[tuple[Any, Any]]:
    """``(item, work(item))`` for every item, in children of this process; a child that is lost is
    replaced.

    Where the child ended, or took longer than ``at_most_s``, the result is a text that begins with
    ``LOST``.
    """
    waiting = list(items)
    while waiting:
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(reading)
            _serve(work, waiting, writing, int(memory_gib * 2**30))
        os.close(writing)
        done, hangs, status = 0, False, 0
        try:
            with os.fdopen(reading, "rb") as results:
                while done < len(waiting) and select.select([results], [], [], at_most_s)[0]:
                    try:
                        result = pickle.load(results)  # our own child's
                    except EOFError:
                        break
                    yield waiting[done], result
                    done += 1
                hangs = done < len(waiting) and not select.select([results], [], [], 0)[0]
        finally:  # also where the caller has had enough
            os.kill(child, signal.SIGKILL)
            _, status = os.waitpid(child, 0)
        if done < len(waiting):
            why = f"more than {at_most_s:g} s" if hangs else f"the process ended (status {status})"
            yield waiting[done], f"LOST: {why}"
            done += 1
        waiting = waiting[done:]


def _serve(work: Callable[[Any], Any], items: list[Any], writing: int, memory: int) -> None:
    """Do the work and write the results, then end this process."""
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    try:
        # Unbuffered, and one write for each result: what select sees is all there is.
        for item in items:
            os.write(writing, pickle.dumps(work(item)))
        os.close(writing)
        while True:  # the parent ends it, once it has read everything
            time.sleep(60)
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(1)
