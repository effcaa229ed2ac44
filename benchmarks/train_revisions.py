"""``ganlane train`` of this checkout and of an older revision, in turns: decisions per second with
learning.

    python -m benchmarks.train_revisions --revision 82e9c00
    python -m benchmarks.train_revisions --environments 1024 --cores 0 1 --collectors single
    single:2 overlap

Every case is a real run of the command, logs included and checkpoints not, with the agent of
``agent=rainbow``. All are started at once and stopped (SIGSTOP) except for the one whose turn it
is, so that a change of the machine's speed meets all alike. The older revision runs with one core,
in a worktree of git that is removed afterwards. Linux alone.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from statistics import median

from benchmarks.script import ReportSection, add_report, checkout_of, make_parser, run_script
from ganlane.errors import UserError
from ganlane.evaluation import machine_sentence
from ganlane.evaluation.table import Table, count

BEGIN, END = "<!-- begin train revisions -->", "<!-- end train revisions -->"
HERE = Path(__file__).resolve().parents[1]
OPTIONS = (
    *("init=none", "agent=rainbow", "observation=lane_view", "env.compile=true", "seed=0"),
    *("total_decisions=1000000000", "checkpoint_every_s=1000000000", "logger.progress=false"),
)
#: Decisions between two rows of metrics.csv, by which progress is seen.
ROW = 2048
_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")


@dataclass
class Run:
    """A training that runs in turns.

    ``rates`` are its decisions per second and per CPU-second by turn.
    """

    name: str
    traffic: str
    source: Path
    options: list[str]
    cores: list[int]
    folder: Path
    threads: int = 1
    rates: list[tuple[float, float]] = field(default_factory=list)

    def start(self) -> None:
        """The command, in a process group of its own."""
        own = [
            f"traffic={self.traffic}",
            f"threads={self.threads}",
            f"log_every={ROW}",
            *self.options,
        ]
        command = ["-m", "ganlane.train", *OPTIONS, *own]
        self.folder.mkdir(parents=True)
        with (self.folder / "messages.txt").open("w") as messages:
            self.process = subprocess.Popen(
                [sys.executable, *command, f"hydra.run.dir={self.folder}"],
                cwd=self.folder,
                env={
                    **os.environ,
                    "PYTHONPATH": str(self.source),
                    "OMP_NUM_THREADS": str(self.threads),
                },
                stdout=messages,
                stderr=messages,
                preexec_fn=lambda: os.sched_setaffinity(0, self.cores),
                start_new_session=True,
            )

    def send(self, number: int) -> None:
        """A signal to all its processes."""
        os.killpg(self.process.pid, number)

    def wait_for_rows(self, rows: int) -> None:
        """Until so many more rows of figures are written.

        Raises:
            UserError: the run ended.
        """
        path = self.folder / "metrics.csv"
        wanted = _lines(path) + rows
        while _lines(path) < wanted:
            if self.process.poll() is not None:
                raise UserError(f"{self.name}: the run ended, see {self.folder}/messages.txt")
            time.sleep(0.002)

    def turn(self, rows: int) -> None:
        """Run for so many rows, and count from the end of the row that is under way."""
        self.send(signal.SIGCONT)
        self.wait_for_rows(1)
        cpu_s, wall_s = group_cpu_s(self.process.pid), time.perf_counter()
        self.wait_for_rows(rows)
        cpu_s, wall_s = group_cpu_s(self.process.pid) - cpu_s, time.perf_counter() - wall_s
        self.send(signal.SIGSTOP)
        self.rates.append((rows * ROW / wall_s, rows * ROW / max(cpu_s, _TICK_S)))


def _lines(path: Path) -> int:
    return path.read_bytes().count(b"\n") if path.is_file() else 0


def group_cpu_s(group: int) -> float:
    """Processor time so far of all processes of a group."""
    ticks = 0
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            words = path.read_text().rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        if int(words[2]) == group:
            ticks += int(words[11]) + int(words[12])
    return ticks * _TICK_S


def runs_of(options: argparse.Namespace, old: Path, folder: Path) -> list[list[Run]]:
    """Per traffic the older revision and every collector."""
    everywhere = [f"collector.num_envs={options.environments}", *options.options]
    found = []
    for traffic in options.traffics:
        first = options.cores[:1]
        where = folder / traffic
        of_old = Run(options.revision, traffic, old, everywhere[:1], first, where / "old")
        group = [of_old]
        for name in options.collectors:
            collector, _, threads = name.partition(":")
            cores = first if name == "single" else options.cores
            own = [f"collector={collector}", "mask=none", *everywhere]
            title = f"collector={collector}" + (f" threads={threads}" if threads else "")
            group.append(Run(title, traffic, HERE, own, cores, where / name, int(threads or 1)))
        found.append(group)
    return found


def measure(options: argparse.Namespace) -> str:
    """Run everything; the table, in the document too where one is named."""
    section = ReportSection(options.report, BEGIN, END)
    lines = []
    with tempfile.TemporaryDirectory() as place, checkout_of(options.revision) as old:
        for group in runs_of(options, old, Path(place)):
            take_turns(group, options)
            for run in group:
                pairs = list(zip(run.rates, group[0].rates))
                times = [median(own[i] / base[i] for own, base in pairs) for i in (0, 1)]
                rates = [median(each[i] for each in run.rates) for i in (0, 1)]
                figures = [count(rates[0]), f"{times[0]:.2f}", count(rates[1]), f"{times[1]:.2f}"]
                lines.append([run.traffic, run.name, str(len(run.cores)), *figures])
    headings = ["traffic", "run", "cores", "decisions/s", "times", "decisions/CPU-s", "times"]
    note = (
        f"Medians of {options.turns} turns of {options.rows * ROW} decisions; {options.environments} environments, "
        f"one update of batch 256 per 64 decisions; times: against {options.revision} in the same turn."
    )
    taken = f"Taken on {date.today()}: {machine_sentence([1])}"
    text = f"{taken}\n\n{Table('Training against an older revision', headings, lines, 2, [note]).markdown()}"
    section.write(f"\n{text}\n")
    return text


def take_turns(group: Sequence[Run], options: argparse.Namespace) -> None:
    """All runs of a group, one after the other until each is past its warm-up, then in turns."""
    try:
        for run in group:
            run.start()
            run.wait_for_rows(1 + options.warm)
            run.send(signal.SIGSTOP)
        for turn in range(options.turns):
            for run in group:
                run.turn(options.rows)
                print(f"turn {turn}, {run.traffic}, {run.name}: {run.rates[-1]}", file=sys.stderr)
    finally:
        for run in group:
            if hasattr(run, "process"):
                run.send(signal.SIGKILL)
                run.process.wait()


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = make_parser(__doc__)
    parser.add_argument("--revision", default="82e9c00")
    parser.add_argument("--traffics", nargs="+", default=["idm_mobil", "gan"])
    parser.add_argument("--collectors", nargs="+", default=["single"], help="NAME, or NAME:THREADS")
    parser.add_argument(
        "--cores", type=int, nargs="+", default=[0], help="the first one for what needs only one"
    )
    parser.add_argument("--environments", type=int, default=512)
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--rows", type=int, default=10, help=f"of {ROW} decisions, per turn")
    parser.add_argument("--warm", type=int, default=12, help="rows before the first turn")
    parser.add_argument(
        "--options", nargs="*", default=[], help="of ganlane train, not for the older revision"
    )
    add_report(parser, BEGIN, END)
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure; the exit status."""
    return run_script(measure, parse(arguments))


if __name__ == "__main__":
    sys.exit(main())
