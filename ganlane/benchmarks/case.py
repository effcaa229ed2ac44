"""What a suite is made of: cases with labels, in groups that are measured together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from ganlane.benchmarks.tables import Table

#: Takes so many decisions in every row of the batch; returns the physics steps simulated in all rows together.
Runner = Callable[[int], int]

#: Labels and figures of a case (:func:`ganlane.benchmarks.rows.make_row`).
Row = dict[str, Any]

EAGER = "eager"
COMPILED = "compiled"


@dataclass(frozen=True)
class Labels:
    """What was measured: the first columns of a row.

    ``part`` is the question within the suite that the row answers, ``batch`` the number of environments side by side,
    ``threads`` torch's.
    """

    suite: str
    part: str
    system: str
    traffic: str
    mode: str
    dtype: str
    device: str
    threads: int
    vehicles: int
    lanes: int
    batch: int


class Case(NamedTuple):
    """Something to measure; ``start`` builds it, and is a picklable call so that a fresh process can do it too."""

    labels: Labels
    start: Callable[[], Runner]


class Group(NamedTuple):
    """Cases that take turns under ``threads`` of torch's; ``reference`` is the one that the others are held against.

    The reference is a peer's, or None where there is none.
    """

    title: str
    threads: int
    cases: Sequence[Case]
    reference: Case | None = None

    def all_cases(self) -> list[Case]:
        """The reference first, if there is one."""
        return [*([] if self.reference is None else [self.reference]), *self.cases]


class Suite(Protocol):
    """What the command measures under one name."""

    name: str
    #: Whether to measure the peak memory of every case.
    memory: bool
    #: One sentence for everything that could not be measured here.
    notes: list[str]

    def groups(self) -> Sequence[Group]:
        """All that is timed."""

    def findings(self, rows: Sequence[Row]) -> dict[str, Any]:
        """What follows from the rows, and figures that need no timing, for ``results.json``."""

    def tables(self, rows: Sequence[Row], findings: Mapping[str, Any]) -> list[Table]:
        """Rows and findings for a reader."""
