"""Physics steps per CPU-second of the eager tensor code, of this checkout and of an older revision,
in turns.

    python -m benchmarks.eager_revisions --revision 82e9c00
    python -m benchmarks.eager_revisions --cases 30,256,3 200,64,6 --turns 5

A case is vehicles, batch and lanes. Bare physics of ``idm_mobil``, without kernel and compiler: no
observation, no reward, no resets; the ego keeps its lane. Each revision has a process of its own,
which computes when it is told to.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from benchmarks.script import checkout_of, make_parser, run_script
from ganlane.evaluation import machine_sentence
from ganlane.evaluation.table import Table, count

HERE = Path(__file__).resolve().parents[1]
#: Runs with the modules of either revision, some of which have moved since.
_WORKER = """
import sys, time, torch
from ganlane import keys
from ganlane.env import HighwayEnv
from ganlane.sim import Road
from ganlane.traffic import IdmMobilTraffic
try:
    from ganlane.settings.episode import SpawnParameters
except ImportError:
    from ganlane.sim import SpawnParameters

torch.set_num_threads(1)
vehicles, rows, lanes = map(int, sys.argv[1:])
room = SpawnParameters().min_spacing_m * (vehicles / lanes + 2)
spawn = SpawnParameters(spread_m=max(200.0, room))
with torch.inference_mode():
    env = HighwayEnv(IdmMobilTraffic(Road(lanes)), num_envs=rows, vehicles=vehicles, spawn_parameters=spawn)
    td = env.reset()
    for _ in range(11):
        td[keys.ACTION] = torch.zeros(rows, dtype=torch.int64)
        last, td = td, env.step_and_maybe_reset(td)[1]
    print("ready", flush=True)
    for _ in sys.stdin:
        decisions, start = 0, time.process_time()
        while (used := time.process_time() - start) < 0.6:
            env._step(last)
            decisions += 1
        print(10 * rows * decisions / used, flush=True)
"""


class Worker:
    """The process of one revision and case."""

    def __init__(self, source: Path, case: str) -> None:
        environment = {**os.environ, "PYTHONPATH": str(source), "OMP_NUM_THREADS": "1"}
        command = [sys.executable, "-c", _WORKER, *case.split(",")]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        self.process = subprocess.Popen(command, cwd=source, env=environment, text=True, **pipes)
        self.answer()

    def answer(self) -> str:
        """The next line that it prints."""
        assert self.process.stdout is not None
        return self.process.stdout.readline()

    def turn(self) -> float:
        """Physics steps per CPU-second."""
        assert self.process.stdin is not None
        self.process.stdin.write("go\n")
        self.process.stdin.flush()
        return float(self.answer())


def measure(options: argparse.Namespace) -> str:
    """All cases, as a table."""
    lines = []
    with checkout_of(options.revision) as old:
        for case in options.cases:
            workers = [Worker(source, case) for source in (old, HERE)]
            turns = [[worker.turn() for worker in workers] for _ in range(options.turns)]
            for worker in workers:
                worker.process.kill()
                worker.process.communicate()
            vehicles, rows, lanes = case.split(",")
            rates = [median(each) for each in zip(*turns)]
            times = median(new / before for before, new in turns)
            lines.append([f"{vehicles}, {lanes}", rows, *map(count, rates), f"{times:.2f}"])
    headings = ["vehicles, lanes", "batch", options.revision, "now", "times"]
    note = (
        f"Physics steps per CPU-second, medians of {options.turns} turns. {machine_sentence([1])}"
    )
    return Table(
        "Eager tensor code against an older revision", headings, lines, 1, [note]
    ).markdown()


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = make_parser(__doc__)
    parser.add_argument("--revision", default="82e9c00")
    parser.add_argument(
        "--cases", nargs="+", default=["9,256,3", "9,4096,3", "30,256,3", "30,1024,3", "200,64,6"]
    )
    parser.add_argument("--turns", type=int, default=3)
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure; the exit status."""
    return run_script(measure, parse(arguments))


if __name__ == "__main__":
    sys.exit(main())
