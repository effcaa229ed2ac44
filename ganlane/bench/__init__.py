"""``ganlane bench``: physics steps and decisions per second, memory, and the ratio to a peer in the
same run.

    ganlane bench suite=sim
    ganlane bench suite=sim quick=true
    ganlane bench suite=sim 'batches=[1,1024]' 'threads=[1]' 'modes=[eager]' repetitions=9
    ganlane bench suite=sim report=docs/performance.md
    ganlane bench suite=traffic report=docs/performance.md
    ganlane bench suite=train 'modes=[eager]' 'train_batches=[512]' seconds=2

Writes results.json into its run folder, and with ``report`` the tables into that document.

A suite lists groups of cases. The cases of a group take turns (A B C A B C), so that other work on
the machine slows all of them alike; each case gives one row of medians and ratios.

Modules:

- :mod:`~ganlane.bench.measure`: cases, groups and suites; timing, memory, rows.
- :mod:`~ganlane.bench.systems`: the simulator, a training, and their peers, ready to run.
- :mod:`~ganlane.bench.suites`: the three suites.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

from ganlane.config.app import run_command


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    # A thread of OpenMP that spins while it waits takes time from cases that run at the same time.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    return run_command("bench", arguments)
