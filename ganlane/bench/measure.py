"""Side-by-side timing.

Cases that take turns, their rows of medians and ratios, and their peak memory.
"""

from __future__ import annotations

import math
import multiprocessing
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from statistics import median
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch

from ganlane.settings.commands import BenchConfig
from ganlane.errors import UserError
from ganlane.evaluation.table import NOTHING, Table, count, percent, significant
from ganlane.runtime import peak_resident_bytes

#: Makes so many decisions in every environment; returns the physics steps simulated in all of them
#: together.
Runner = Callable[[int], int]
#: Labels and figures of a case (:func:`make_row`).
Row = dict[str, Any]

EAGER, COMPILED, NATIVE = "eager", "compiled", "native"
#: Upper limit of the decisions in a turn.
_MOST_DECISIONS = 2**20


@dataclass(frozen=True)
class Labels:
    """What was measured: the first columns of a row.

    ``part`` is the question within the suite, ``batch`` the number of environments side by side,
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
    """Something to measure.

    ``start`` builds it and can be pickled, so that a fresh process can call it too.
    """

    labels: Labels
    start: Callable[[], Runner]


class Group(NamedTuple):
    """Cases that take turns under ``threads`` of torch's.

    ``reference`` is the peer that they are compared with.
    """

    title: str
    threads: int
    cases: Sequence[Case]
    reference: Case | None = None


class Suite(ABC):
    """What the command measures under one name.

    ``notes`` has a sentence for everything that cannot be measured here; with ``memory`` the peak
    memory of every case of the part ``speed`` is measured, too.
    """

    name: ClassVar[str]
    memory = False

    def __init__(self, config: BenchConfig) -> None:
        self.config = config
        self.notes: list[str] = []

    @abstractmethod
    def groups(self) -> Sequence[Group]:
        """All groups of cases to time."""

    @abstractmethod
    def findings(self, rows: Sequence[Row]) -> dict[str, Any]:
        """Results computed from the rows, for ``results.json``."""

    @abstractmethod
    def tables(self, rows: Sequence[Row], findings: Mapping[str, Any]) -> list[Table]:
        """Rows and findings for a reader; empty tables are left out."""

    def places(self) -> list[tuple[str, int]]:
        """Devices with numbers of threads.

        A GPU gets the first number alone, since its work hardly depends on it.
        """
        threads, devices = self.config.threads, self.config.chosen_devices()
        own = [("cpu", number) for number in threads] if "cpu" in devices else []
        return own + [(device, threads[0]) for device in devices if device != "cpu"]

    def labels(
        self, system: str, traffic: str, mode: str, threads: int, batch: int, **others: Any
    ) -> Labels:
        """Labels of a case on the configured road; ``others`` overrides the defaults."""
        env = self.config.env
        road = (threads, env.vehicles, env.lanes, batch)
        return replace(
            Labels(self.name, "speed", system, traffic, mode, "float32", "cpu", *road), **others
        )


class Sample(NamedTuple):
    """One turn of a case.

    Seconds of wall and CPU time (all threads of the process), and what was done in it.
    """

    wall_s: float
    cpu_s: float
    decisions: int
    physics_steps: int

    @property
    def rates(self) -> tuple[float, float]:
        """Physics steps per second of wall and of CPU time; a coarse CPU clock may not have moved."""
        return self.physics_steps / self.wall_s, self.physics_steps / max(self.cpu_s, 1e-6)


@contextmanager
def torch_threads(threads: int) -> Iterator[None]:
    """Let torch use so many threads inside."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def take_turn(case: Case, run: Runner, decisions: int) -> Sample:
    """One turn of ``decisions`` per environment; in inference mode, as in collecting."""
    wait = torch.cuda.synchronize if case.labels.device == "cuda" else lambda: None
    wait()
    wall, cpu = time.perf_counter(), time.process_time()
    with torch.inference_mode():
        physics_steps = run(decisions)
    wait()
    wall_s, cpu_s = time.perf_counter() - wall, time.process_time() - cpu
    return Sample(wall_s, cpu_s, decisions * case.labels.batch, physics_steps)


def decisions_per_turn(case: Case, run: Runner, seconds: float) -> int:
    """How many decisions fill a turn of ``seconds``; measuring it is the warm-up.

    The first decision (compilation, caches) does not count. The number doubles until a turn is much
    longer than the clock's resolution.
    """
    take_turn(case, run, 1)
    decisions, wall_s = 1, take_turn(case, run, 1).wall_s
    while wall_s < seconds / 4 and decisions < _MOST_DECISIONS:
        decisions *= 2
        wall_s = take_turn(case, run, decisions).wall_s
    return min(math.ceil(decisions * seconds / wall_s), _MOST_DECISIONS)


def take_turns(
    cases: Sequence[Case], runners: Sequence[Runner], repetitions: int, seconds: float
) -> list[list[Sample]]:
    """Samples of each case, ``repetitions`` turns of about ``seconds`` each.

    A B C A B C ..., after a warm-up.
    """
    turns = [decisions_per_turn(case, run, seconds) for case, run in zip(cases, runners)]
    samples: list[list[Sample]] = [[] for _ in cases]
    for _ in range(repetitions):
        for case, run, decisions, taken in zip(cases, runners, turns, samples):
            taken.append(take_turn(case, run, decisions))
    return samples


def _peak_here(case: Case) -> int | None:
    """Peak bytes: of this process on a CPU, of torch's allocations on a GPU."""
    with torch_threads(case.labels.threads):
        case.start()(3)  # after so many decisions every buffer is allocated
    return (
        torch.cuda.max_memory_allocated() if case.labels.device == "cuda" else peak_resident_bytes()
    )


def peak_bytes(case: Case) -> int | None:
    """Peak memory of a fresh process that runs the case, Python and torch included."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_peak_here, case).result()


def growth_per_environment(small: Case, large: Case) -> float | None:
    """Bytes by which peak memory grows with every environment, from two batch sizes in fresh
    processes.
    """
    low, high = peak_bytes(small), peak_bytes(large)
    if low is None or high is None:
        return None
    return (high - low) / (large.labels.batch - small.labels.batch)


def make_row(
    labels: Labels,
    samples: Sequence[Sample],
    reference: Sequence[Sample] = (),
    peak_memory_mb: float | None = None,
) -> Row:
    """One row: medians over the turns ``samples`` of a case.

    ``reference``: turns of the case that it is compared with, taken in turn with them; may be
    empty.

    Returns:
        The labels; ``physics_steps_per_s``, ``decisions_per_s``, ``vehicle_steps_per_s`` (per
        second of wall time) and ``physics_steps_per_cpu_s``; ``wall_s`` and ``cpu_s`` of one turn
        and the ``decisions`` taken in it by all environments together; ``repetitions`` and
        ``spread`` (interquartile range of the turns' wall time over its median); ``ratio`` and
        ``ratio_cpu`` (physics steps per second of wall and CPU time over the reference's turn of
        the same round, median of the rounds; or None); ``peak_memory_mb``.
    """
    per_s, per_cpu_s = map(median, zip(*(sample.rates for sample in samples)))
    ratio = ratio_cpu = None
    if reference:
        compared = np.divide(
            [sample.rates for sample in samples], [sample.rates for sample in reference]
        )
        ratio, ratio_cpu = np.median(compared, axis=0).tolist()
    walls_s = [sample.wall_s for sample in samples]
    return {
        **asdict(labels),
        "physics_steps_per_s": per_s,
        "decisions_per_s": median(sample.decisions / sample.wall_s for sample in samples),
        "vehicle_steps_per_s": per_s * labels.vehicles,
        "physics_steps_per_cpu_s": per_cpu_s,
        "wall_s": median(walls_s),
        "cpu_s": median(sample.cpu_s for sample in samples),
        "decisions": samples[0].decisions,
        "repetitions": len(samples),
        "spread": float(np.subtract(*np.quantile(walls_s, [0.75, 0.25])) / median(walls_s)),
        "ratio": ratio,
        "ratio_cpu": ratio_cpu,
        "peak_memory_mb": peak_memory_mb,
    }


def _words(name: str) -> Callable[[Row], str]:
    return lambda row: str(row[name])


#: Heading to cell of the columns that the suites' tables of speed choose from.
COLUMNS: dict[str, Callable[[Row], str]] = {
    **{name: _words(name) for name in ("system", "traffic", "mode", "device", "threads", "batch")},
    "environments": _words("batch"),
    "physics steps/s": lambda row: count(row["physics_steps_per_s"]),
    "decisions/s": lambda row: count(row["decisions_per_s"]),
    "vehicle-steps/s": lambda row: count(row["vehicle_steps_per_s"]),
    "physics steps/CPU-s": lambda row: count(row["physics_steps_per_cpu_s"]),
    "decisions/CPU-s": lambda row: count(row["decisions"] / row["cpu_s"] if row["cpu_s"] else None),
    "times the peer": lambda row: significant(row["ratio"]),
    "in CPU time": lambda row: significant(row["ratio_cpu"]),
    "spread": lambda row: percent(row["spread"]),
    "peak memory, MB": lambda row: (
        NOTHING if row["peak_memory_mb"] is None else f"{row['peak_memory_mb']:.0f}"
    ),
}


def speed_table(title: str, rows: Sequence[Row], headings: Sequence[str], names: int) -> Table:
    """The rows with these of the :data:`COLUMNS`; the title names vehicles and lanes."""
    where = f", {rows[0]['vehicles']} vehicles on {rows[0]['lanes']} lanes" if rows else ""
    spread = (
        "Medians; spread is the interquartile range of the repetitions' wall time over its median."
    )
    notes = [spread] if "spread" in headings else []
    return Table.of(
        f"{title}{where}", rows, {name: COLUMNS[name] for name in headings}, names, notes
    )


def best_rows(rows: Sequence[Row], figure: str) -> list[Row]:
    """The row with the highest ``figure`` of each system and traffic on each device, in the order
    of ``rows``.
    """
    best: dict[tuple[str, str, str], Row] = {}
    for row in rows:
        key = row["device"], row["system"], row["traffic"]
        best[key] = max(best.get(key, row), row, key=lambda each: each[figure])
    return list(best.values())


def measure(suite: Suite, repetitions: int, seconds: float) -> dict[str, Any]:
    """All that ``results.json`` holds of a suite: ``rows``, its findings, and ``notes``.

    A reference takes turns in every group; its turns of all groups make one row, which comes first.
    """
    rows: list[Row] = []
    references: dict[Labels, tuple[Case, list[Sample]]] = {}
    peaks: dict[Labels, float | None] = {}

    def peak_mb(case: Case) -> float | None:
        if not suite.memory or case.labels.part != "speed":
            return None
        same = replace(case.labels, threads=1)  # whose number does not change it
        if same not in peaks:
            peak = peak_bytes(case)
            peaks[same] = None if peak is None else peak / 1e6
        return peaks[same]

    groups = suite.groups()
    for number, group in enumerate(groups, 1):
        with torch_threads(group.threads):
            cases, runners = _start(group, suite.notes)
            samples = take_turns(cases, runners, repetitions, seconds)
        del runners
        reference: list[Sample] = []
        if group.reference is not None:
            (_, *cases), (reference, *samples) = cases, samples
            references.setdefault(group.reference.labels, (group.reference, []))[1].extend(
                reference
            )
        found = [
            make_row(case.labels, taken, reference, peak_mb(case))
            for case, taken in zip(cases, samples)
        ]
        figures = ", ".join(
            f"{row['system']} {row['mode']} {count(row['physics_steps_per_s'])}" for row in found
        )
        print(
            f"{number}/{len(groups)} {group.title}: physics steps/s {figures}",
            file=sys.stderr,
            flush=True,
        )
        rows += found
    peers = [
        make_row(case.labels, taken, taken, peak_mb(case)) for case, taken in references.values()
    ]
    rows = [*peers, *rows]
    return {"rows": rows, **suite.findings(rows), "notes": suite.notes}


def _start(group: Group, notes: list[str]) -> tuple[list[Case], list[Runner]]:
    """The reference, if any, and the cases that run here.

    A mode that cannot do a case leaves it out, with a note.
    """
    if any(case.labels.mode == COMPILED for case in group.cases):
        # Each group compiles for its own sizes; torch would fall back to eager after a few
        # recompilations.
        torch.compiler.reset()
    cases, runners = [], []
    for case in [*([] if group.reference is None else [group.reference]), *group.cases]:
        try:
            runners.append(case.start())
            cases.append(case)
        except UserError as error:
            if case.labels.mode == EAGER:
                raise
            if str(error) not in notes:
                notes.append(str(error))
    return cases, runners
