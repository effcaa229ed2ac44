"""Wall and CPU time of cases that take turns, so that a busy moment of the machine meets all of them alike."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch

from ganlane.benchmarks.case import Case, Runner

#: In a turn, however little one costs.
_MOST_DECISIONS = 2**20


@dataclass(frozen=True)
class Budget:
    """How often each case is measured, and how long a turn lasts at least (s, wall; one decision may last longer)."""

    repetitions: int = 5
    seconds: float = 0.5


@dataclass(frozen=True)
class Sample:
    """One turn of a case: s of wall and CPU time (all threads of the process), and what was done in it."""

    wall_s: float
    cpu_s: float
    decisions: int
    physics_steps: int


@contextmanager
def torch_threads(threads: int) -> Iterator[None]:
    """Let torch use so many threads inside."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def take(case: Case, run: Runner, decisions: int) -> Sample:
    """One turn of ``decisions`` per row; no gradients are kept, as in collecting."""
    synchronize(case)
    wall, cpu = time.perf_counter(), time.process_time()
    with torch.inference_mode():
        physics_steps = run(decisions)
    synchronize(case)
    wall_s, cpu_s = time.perf_counter() - wall, time.process_time() - cpu
    return Sample(wall_s, cpu_s, decisions * case.labels.batch, physics_steps)


def synchronize(case: Case) -> None:
    """Wait for the device; a CPU is never behind."""
    if case.labels.device == "cuda":
        torch.cuda.synchronize()


def decisions_per_turn(case: Case, run: Runner, seconds: float) -> int:
    """How many decisions fill a turn; measuring it is the warm-up.

    The first decision (compilation, caches) does not count. The number doubles until a turn is long enough to be
    told from the clock's noise.
    """
    take(case, run, 1)
    decisions, wall_s = 1, take(case, run, 1).wall_s
    while wall_s < seconds / 4 and decisions < _MOST_DECISIONS:
        decisions *= 2
        wall_s = take(case, run, decisions).wall_s
    return min(math.ceil(decisions * seconds / wall_s), _MOST_DECISIONS)


def take_turns(cases: Sequence[Case], runners: Sequence[Runner], budget: Budget) -> list[list[Sample]]:
    """Samples of each case: A B C A B C ..., after a warm-up of each."""
    turns = [decisions_per_turn(case, run, budget.seconds) for case, run in zip(cases, runners)]
    samples: list[list[Sample]] = [[] for _ in cases]
    for _ in range(budget.repetitions):
        for case, run, decisions, taken in zip(cases, runners, turns, samples):
            taken.append(take(case, run, decisions))
    return samples
