"""Running a suite: every group in turns, every case once more for its memory."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from tqdm import tqdm

from ganlane.benchmarks.case import COMPILED, Case, Group, Labels, Row, Suite
from ganlane.benchmarks.memory import peak_memory_mb
from ganlane.benchmarks.rows import make_row
from ganlane.benchmarks.tables import count
from ganlane.benchmarks.timing import Budget, Sample, take_turns, torch_threads
from ganlane.errors import UserError


def measure(suite: Suite, budget: Budget) -> dict[str, Any]:
    """All that ``results.json`` holds of a suite: ``rows``, its findings, and ``notes``.

    The reference stands in every group; its turns of all groups make one row.
    """
    meter = _Meter(suite)
    groups = suite.groups()
    with tqdm(total=len(groups), unit="group", file=sys.stderr, disable=not sys.stderr.isatty()) as bar:
        for group in groups:
            bar.set_description(group.title)
            rows = meter.group(group, budget)
            bar.update()
            if bar.disable:
                print(_line(group, rows), file=sys.stderr, flush=True)
    rows = meter.all_rows()
    return {"rows": rows, **suite.findings(rows), "notes": suite.notes}


def _line(group: Group, rows: Sequence[Row]) -> str:
    """A group in a log."""
    figures = ", ".join(f"{row['system']} {row['mode']} {count(row['physics_steps_per_s'])}" for row in rows)
    return f"{group.title}: physics steps/s {figures}"


class _Meter:
    """Rows so far, the turns of references by their labels, and peak memory by case."""

    def __init__(self, suite: Suite) -> None:
        self.suite = suite
        self.rows: list[Row] = []
        self.references: dict[Labels, tuple[Case, list[Sample]]] = {}
        self.peaks: dict[Labels, float | None] = {}

    def group(self, group: Group, budget: Budget) -> list[Row]:
        """Measure a group and keep its rows."""
        with torch_threads(group.threads):
            cases, runners = self._started(group)
            samples = take_turns(cases, runners, budget)
        del runners
        reference: list[Sample] = []
        if group.reference is not None:
            reference, cases, samples = samples[0], cases[1:], samples[1:]
            self.references.setdefault(group.reference.labels, (group.reference, []))[1].extend(reference)
        rows = [make_row(c.labels, s, reference, self._peak(c)) for c, s in zip(cases, samples)]
        self.rows += rows
        return rows

    def _started(self, group: Group) -> tuple[list[Case], list[Any]]:
        """Cases that run here; one that cannot be compiled is left out with the reason."""
        if any(case.labels.mode == COMPILED for case in group.cases):
            # Each group compiles for its own sizes; torch would fall back to eager after a few recompilations.
            torch.compiler.reset()
        cases, runners = [], []
        for case in group.all_cases():
            try:
                runners.append(case.start())
                cases.append(case)
            except UserError as error:
                if case.labels.mode != COMPILED:
                    raise
                self._note(str(error))
        return cases, runners

    def _note(self, sentence: str) -> None:
        if sentence not in self.suite.notes:
            self.suite.notes.append(sentence)

    def _peak(self, case: Case) -> float | None:
        """Peak memory, of the rows that tell of speed; the number of threads does not change it."""
        if not self.suite.memory or case.labels.part != "speed":
            return None
        same = replace(case.labels, threads=1)
        if same not in self.peaks:
            self.peaks[same] = peak_memory_mb(case)
        return self.peaks[same]

    def all_rows(self) -> list[Row]:
        """Rows of the references first."""
        peers = [make_row(c.labels, s, s, self._peak(c)) for c, s in self.references.values()]
        return [*peers, *self.rows]
