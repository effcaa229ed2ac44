"""Run a suite of benchmarks, print its tables and write them into a document."""

from __future__ import annotations

import sys
from dataclasses import asdict
from datetime import date
from pathlib import Path

from ganlane.bench.measure import Suite, measure
from ganlane.bench.suites import SimSuite, TrafficSuite, TrainSuite
from ganlane.settings.commands import BenchConfig
from ganlane.config.runs import stored_command
from ganlane.evaluation import machine_sentence, write_results
from ganlane.evaluation.table import show
from ganlane.files import split_at_markers, write_between_markers

_SUITES: tuple[type[Suite], ...] = (SimSuite, TrafficSuite, TrainSuite)


def bench(config: BenchConfig, folder: Path) -> str:
    """Measure, print and save; the line that names the results."""
    config = config.shortened()
    markers = f"<!-- begin bench {config.suite} -->", f"<!-- end bench {config.suite} -->"
    if config.report is not None:
        split_at_markers(Path(config.report), *markers)
    suite = {each.name: each for each in _SUITES}[config.suite](config)
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
        command = stored_command(folder, "python -m ganlane.bench", without=("report=", "hydra."))
        parts = [
            f"Written by the command on {date.today().isoformat()}:\n\n    {command}",
            f"Taken on: {machine_sentence(config.threads)}",
            *[table.markdown() for table in tables],
            *(["\n".join(f"- {note}" for note in suite.notes)] if suite.notes else []),
        ]
        write_between_markers(Path(config.report), *markers, "\n" + "\n\n".join(parts) + "\n")
    return f"results: {path}"
