"""``ganlane bench``: physics steps and decisions per second, memory, and the ratio to a peer in the same run.

    ganlane bench suite=sim
    ganlane bench suite=sim quick=true
    ganlane bench suite=sim 'batches=[1,1024]' 'threads=[1]' 'modes=[eager]' repetitions=9
    ganlane bench suite=sim report=docs/performance.md
    ganlane bench suite=traffic report=docs/performance.md
    ganlane bench suite=train 'modes=[eager]' 'train_batches=[512]' seconds=2

Writes results.json into its run folder, and with ``report`` the tables into that document.
"""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

from ganlane.config.app import run_command
from ganlane.config.bench import BenchConfig

if TYPE_CHECKING:
    from ganlane.benchmarks import Suite


def bench(asked: BenchConfig, folder: Path) -> str:
    """Measure, print, and keep."""
    from ganlane.benchmarks import Budget, measure, print_report, report_sections, update_document
    from ganlane.benchmarks.report import require_markers
    from ganlane.evaluation import write_results

    config = asked.shortened()
    report = None if config.report is None else Path(config.report)
    if report is not None:
        require_markers(report, config.suite)
    suite = SUITES[config.suite](config)
    for note in suite.notes:
        print(note, file=sys.stderr, flush=True)
    numbers = measure(suite, Budget(config.repetitions, config.seconds))
    print_report(suite, numbers)
    path = write_results(folder, numbers, asdict(config), {"seed": config.seed})
    if report is not None:
        line = command_line(folder)
        today = date.today().isoformat()
        update_document(report, suite.name, report_sections(suite, numbers, line, config.threads, today))
    return f"results: {path}"


def sim_suite(config: BenchConfig) -> Suite:
    """``suite=sim``."""
    from ganlane.benchmarks import SimOptions, SimSuite
    from ganlane.benchmarks.systems import Scenario

    scenario = Scenario(config.env, config.traffic, config.observation, config.reward, config.seed)
    low, high = config.memory_batches
    options = SimOptions(
        scenario=scenario,
        batches=tuple(config.batches),
        modes=tuple(config.modes),
        threads=tuple(config.threads),
        devices=config.chosen_devices(),
        vehicle_counts=tuple(config.vehicle_counts),
        scaling_batch=config.scaling_batch,
        linear_from=config.linear_from,
        memory_batches=(low, high),
        peers=config.peers,
        memory=config.memory,
    )
    return SimSuite(options)


def traffic_suite(config: BenchConfig) -> Suite:
    """``suite=traffic``."""
    from ganlane.benchmarks.traffic import TrafficOptions, TrafficSuite

    options = TrafficOptions(
        env=config.env,
        traffics=config.chosen_traffics(),
        batches=tuple(config.traffic_batches),
        modes=tuple(config.modes),
        threads=tuple(config.threads),
        peers=config.peers,
        seed=config.seed,
    )
    return TrafficSuite(options)


def train_suite(config: BenchConfig) -> Suite:
    """``suite=train``."""
    from ganlane.benchmarks import Budget
    from ganlane.benchmarks.systems import Scenario
    from ganlane.benchmarks.train import TrainOptions, TrainSuite

    options = TrainOptions(
        scenario=Scenario(config.env, config.traffic, config.observation, config.reward, config.seed),
        traffics=config.chosen_train_traffics(),
        agent=config.agent.for_phase(1),
        batches=tuple(config.train_batches),
        modes=tuple(config.modes),
        threads=tuple(config.threads),
        devices=config.chosen_devices(),
        stored=config.train_stored,
        budget=Budget(config.repetitions, config.seconds),
        peers=config.peers,
    )
    return TrainSuite(options)


#: What ``suite=`` can be, and how each is made.
SUITES: dict[str, Callable[[BenchConfig], Suite]] = {
    "sim": sim_suite,
    "traffic": traffic_suite,
    "train": train_suite,
}


def command_line(folder: Path) -> str:
    """How the run in ``folder`` was started, without the paths in it."""
    from omegaconf import OmegaConf

    from ganlane.config.folders import OVERRIDES

    asked = [str(override) for override in OmegaConf.load(folder / OVERRIDES)]
    kept = [override for override in asked if not override.startswith(("report=", "hydra."))]
    return shlex.join(["python", "-m", "ganlane.bench", *kept])


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status.

    A thread of OpenMP's that spins while it waits takes the time of whoever works beside it.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    return run_command("bench", bench, arguments)


if __name__ == "__main__":
    sys.exit(main())
