"""Timing of cases that take turns (A B C A B C ...), and the row of figures of each."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from ganlane.errors import UserError

#: Makes so many calls; the physics steps simulated in all environments together.
Runner = Callable[[int], int]
#: Labels and figures of a case (:func:`make_row`).
Row = dict[str, Any]

#: Upper limit of the calls in a turn.
MOST_CALLS = 2**20


class Labels(NamedTuple):
    """What is measured: the first columns of a row.

    Attributes:
        mode: how the environment is computed: ``eager`` or ``native``.
        threads: of torch.
        batch: environments side by side.
    """

    system: str
    traffic: str
    vehicles: int
    lanes: int
    mode: str
    device: str
    threads: int
    batch: int


class Case(NamedTuple):
    """Something to measure; ``start`` makes it ready to run.

    A call makes ``decisions_per_call`` decisions, one in every environment as a rule.
    """

    labels: Labels
    start: Callable[[], Runner]
    decisions_per_call: int


class Sample(NamedTuple):
    """One turn of a case: seconds of wall and of CPU time (all threads), and what was done."""

    wall_s: float
    cpu_s: float
    decisions: int
    physics_steps: int

    @property
    def rates(self) -> tuple[float, float, float]:
        """Decisions and physics steps per second of wall time, the latter also of CPU time."""
        # A coarse CPU clock may not have moved.
        per_cpu_s = self.physics_steps / max(self.cpu_s, 1e-6)
        return self.decisions / self.wall_s, self.physics_steps / self.wall_s, per_cpu_s


def take_turn(case: Case, run: Runner, calls: int) -> Sample:
    """One turn of ``calls``."""
    wait = torch.cuda.synchronize if case.labels.device == "cuda" else lambda: None
    wait()
    wall, cpu = time.perf_counter(), time.process_time()
    physics_steps = run(calls)
    wait()
    wall_s, cpu_s = time.perf_counter() - wall, time.process_time() - cpu
    return Sample(wall_s, cpu_s, calls * case.decisions_per_call, physics_steps)


def calls_per_turn(case: Case, run: Runner, seconds: float) -> int:
    """How many calls fill a turn of ``seconds``; measuring it is the warm-up."""
    take_turn(case, run, 1)  # with compilation and caches, so it does not count
    calls = 1
    wall_s = take_turn(case, run, calls).wall_s
    # Until a turn is much longer than the clock's resolution.
    while wall_s < seconds / 4 and calls < MOST_CALLS:
        calls *= 2
        wall_s = take_turn(case, run, calls).wall_s
    return min(math.ceil(calls * seconds / wall_s), MOST_CALLS)


def take_turns(
    started: Sequence[tuple[Case, Runner]], repetitions: int, seconds: float
) -> list[list[Sample]]:
    """Samples of each case: ``repetitions`` turns of about ``seconds`` each, after a warm-up."""
    calls = [calls_per_turn(case, run, seconds) for case, run in started]
    samples: list[list[Sample]] = [[] for _ in started]
    for _ in range(repetitions):
        for i, (case, run) in enumerate(started):
            samples[i].append(take_turn(case, run, calls[i]))
    return samples


def make_row(labels: Labels, samples: Sequence[Sample], peer: Sequence[Sample] = ()) -> Row:
    """Medians over the turns of a case.

    Args:
        labels: of the case.
        samples: its turns.
        peer: the turns of the system that it is compared with, if any, of the same rounds.

    Returns:
        The labels; ``physics_steps_per_s``, ``decisions_per_s``, ``physics_steps_per_cpu_s``;
        ``spread``, the interquartile range of the turns' wall time over its median; ``ratio`` and
        ``ratio_cpu``: physics steps per second of wall and of CPU time over the peer's turn of the
        same round, median of the rounds, or None.
    """
    rates = [sample.rates for sample in samples]
    decisions_per_s, per_s, per_cpu_s = np.median(rates, axis=0).tolist()
    low, middle, high = np.quantile([sample.wall_s for sample in samples], [0.25, 0.5, 0.75])
    ratio = ratio_cpu = None
    if peer:
        # Within a round other work on the machine slows both alike.
        ratios = np.divide(rates, [sample.rates for sample in peer])
        _, ratio, ratio_cpu = np.median(ratios, axis=0).tolist()
    return {
        **labels._asdict(),
        "physics_steps_per_s": per_s,
        "decisions_per_s": decisions_per_s,
        "physics_steps_per_cpu_s": per_cpu_s,
        "spread": float((high - low) / middle),
        "ratio": ratio,
        "ratio_cpu": ratio_cpu,
    }


def measure(
    peers: Sequence[Case], cases: Sequence[Case], repetitions: int, seconds: float
) -> list[Row]:
    """Rows of peers and cases with the same number of threads that take turns; ratios are to the
    first peer, if any.
    """
    started: list[tuple[Case, Runner]] = []
    torch.set_num_threads(cases[0].labels.threads)
    for case in (*peers, *cases):
        try:
            started.append((case, case.start()))
        except UserError as error:
            if case.labels.mode == "eager":
                raise
            # No compiler here, or a traffic that the kernel does not drive.
            print(f"left out, {case.labels.mode}: {error}", file=sys.stderr)
    samples = take_turns(started, repetitions, seconds)
    of_peer = samples[0] if peers else []
    return [make_row(case.labels, turns, of_peer) for (case, _), turns in zip(started, samples)]
