"""``ganlane bench``: physics steps and decisions per second, memory, and the ratio to a peer in the same run.

    ganlane bench suite=sim
    ganlane bench suite=sim quick=true
    ganlane bench suite=sim 'batches=[1,1024]' 'threads=[1]' 'modes=[eager]' repetitions=9
    ganlane bench suite=sim report=docs/performance.md
    ganlane bench suite=traffic report=docs/performance.md
    ganlane bench suite=train 'modes=[eager]' 'train_batches=[512]' seconds=2

Writes results.json into its run folder, and with ``report`` the tables into that document.

A suite (:class:`~ganlane.bench.measure.Suite`) lists groups of cases. The cases of a group take turns (A B C A B C),
so that other work on the machine slows all of them alike; each case gives one row of medians and ratios.

- :mod:`~ganlane.bench.measure`: cases, groups and suites; timing, memory, rows.
- :mod:`~ganlane.bench.systems`: the simulator and HighwayEnv as cases.
- :mod:`~ganlane.bench.sim`, :mod:`~ganlane.bench.traffic`, :mod:`~ganlane.bench.train`: the three suites.
"""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict
from datetime import date
from pathlib import Path

from ganlane.config.app import run_command
from ganlane.config.bench import BenchConfig


def bench(asked: BenchConfig, folder: Path) -> str:
    """Measure, print and save; the line that names the results."""
    from ganlane.bench.measure import Suite, measure
    from ganlane.bench.sim import SimSuite
    from ganlane.bench.traffic import TrafficSuite
    from ganlane.bench.train import TrainSuite
    from ganlane.evaluation import machine_sentence, write_results
    from ganlane.evaluation.table import show
    from ganlane.files import split_at_markers, write_between_markers

    config = asked.shortened()
    markers = f"<!-- begin bench {config.suite} -->", f"<!-- end bench {config.suite} -->"
    if config.report is not None:
        split_at_markers(Path(config.report), *markers)
    suites: tuple[type[Suite], ...] = (SimSuite, TrafficSuite, TrainSuite)
    suite = {each.name: each for each in suites}[config.suite](config)
    for note in suite.notes:
        print(note, file=sys.stderr, flush=True)
    numbers = measure(suite, config.repetitions, config.seconds)
    tables = [table for table in suite.tables(numbers["rows"], numbers) if table.lines]
    show(*(table.text() for table in tables), columns=config.columns)
    print()
    for note in suite.notes:
        print(note)
    path = write_results(folder, numbers, asdict(config), {"seed": config.seed})
    if config.report is not None:
        parts = [
            f"Written by the command on {date.today().isoformat()}:\n\n    {command_line(folder)}",
            f"Taken on: {machine_sentence(config.threads)}",
            *[table.markdown() for table in tables],
            *(["\n".join(f"- {note}" for note in suite.notes)] if suite.notes else []),
        ]
        write_between_markers(Path(config.report), *markers, "\n" + "\n\n".join(parts) + "\n")
    return f"results: {path}"


def command_line(folder: Path) -> str:
    """How the run in ``folder`` was started, without the paths in it."""
    from omegaconf import OmegaConf

    from ganlane.config.folders import OVERRIDES

    asked = [str(override) for override in OmegaConf.load(folder / OVERRIDES)]
    kept = [override for override in asked if not override.startswith(("report=", "hydra."))]
    return shlex.join(["python", "-m", "ganlane.bench", *kept])


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    # A thread of OpenMP that spins while it waits takes time from cases that run at the same time.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    return run_command("bench", bench, arguments)
