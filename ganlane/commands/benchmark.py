"""``ganlane benchmark``: agents on a suite."""

from __future__ import annotations

from pathlib import Path

from ganlane.settings.suite import BenchmarkConfig
from ganlane.suite.run import drivers_of, run


def benchmark(config: BenchmarkConfig, folder: Path) -> str:
    """Drive the suite; the line that names report and results."""
    return run(drivers_of(config.agents or config.suite.agents, config), config, folder)
