"""Tries to break the package, and counts what held.

    python -m benchmarks.torture --minutes 60 --report docs/reliability.md     all parts but
    versions python -m benchmarks.torture kill --runs 45 --minutes 15
    python -m benchmarks.torture damage --inputs 10000
    python -m benchmarks.torture damage --input 'scene CSV:17'                 one damaged file
    again python -m benchmarks.torture soak --configurations 500 --minutes 40 --compiled 3
    python -m benchmarks.torture versions                                      in virtual
    environments, half an hour

Parts: kill (kill -9, SIGTERM, SIGINT, then resumed to the same bits), disk (full disks, lost
workers), damage (damaged files), code (ways to have code executed), misuse (of the API), soak
(random configurations), memory (of a long run), cost (of the checks, in training), versions (of the
dependencies). Without a part's name all but the last run. Exits with 1 after a failure. Needs
Linux.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.script import ReportSection, add_report, make_parser
from benchmarks.torture.cost import cost
from benchmarks.torture.damage import Trial, damage, good_files
from benchmarks.torture.disk import disk
from benchmarks.torture.kill import kill
from benchmarks.torture.misuse import code, misuse
from benchmarks.torture.soak import memory, once, soak
from benchmarks.torture.tally import Tally
from benchmarks.torture.versions import versions
from ganlane.errors import UserError
from ganlane.files import write_json

MARKERS = "<!-- begin torture -->", "<!-- end torture -->"
#: Parts, and their shares of the minutes.
SHARES = {
    "kill": 4,
    "disk": 2,
    "damage": 4,
    "code": 0.5,
    "misuse": 2,
    "soak": 8,
    "memory": 1,
    "cost": 1,
}
HEAD = "| part | tried | failed | minutes |\n|---|---|---|---|"


def run(part: str, options: argparse.Namespace, minutes: float, scratch: Path) -> tuple[Tally, str]:
    """One part; its counts, and a table of its own if it has one."""
    tally, begun, table = Tally(part), time.monotonic(), ""
    if part == "kill":
        kill(tally, options.runs, options.seed, minutes, scratch, not options.only_kill)
    elif part == "disk":
        disk(tally, options.disks, options.seed, minutes, scratch)
    elif part == "damage":
        damage(tally, options.inputs, options.seed, minutes, scratch)
    elif part == "code":
        code(tally)
    elif part == "misuse":
        misuse(tally, options.seed, minutes)
    elif part == "soak":
        soak(tally, options.configurations, options.seed, minutes, options.compiled)
    elif part == "memory":
        memory(tally, minutes, options.seed)
    elif part == "cost":
        cost(tally, minutes, options.seed, scratch)
    else:
        table = versions(tally, scratch, options.pin)
    tally.seconds = time.monotonic() - begun
    return tally, table


def main() -> int:
    """Entry point; the exit status."""
    parser = make_parser(__doc__)
    parser.add_argument(
        "parts", nargs="*", choices=[[], *SHARES, "versions"], default=list(SHARES), metavar="PART"
    )
    parser.add_argument("--minutes", type=float, default=10.0, help="of all parts together, about")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--runs", type=int, default=45, help="that kill disturbs")
    parser.add_argument(
        "--only-kill", action="store_true", help="kill -9 alone: no SIGTERM, no SIGINT"
    )
    parser.add_argument(
        "--disks", type=int, default=24, help="runs on full disks and with lost workers"
    )
    parser.add_argument("--inputs", type=int, default=10_000, help="damaged files")
    parser.add_argument("--configurations", type=int, default=500, help="that soak drives")
    parser.add_argument(
        "--compiled", type=int, default=0, help="of them compiled, a minute each before they drive"
    )
    parser.add_argument("--input", help="one damaged file, KIND:NUMBER, as a failure names it")
    parser.add_argument(
        "--configuration", type=int, help="one configuration of soak, as a failure names it"
    )
    parser.add_argument(
        "--pin", nargs="*", default=[], help="for versions: torch==2.13.0 in all environments"
    )
    parser.add_argument("--json", type=Path, help="all counts and failures as JSON")
    add_report(parser, *MARKERS)
    options = parser.parse_args()
    try:
        report = ReportSection(options.report, *MARKERS)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    os.environ.setdefault("GANLANE_CACHE", "")
    here = Path.cwd()
    with tempfile.TemporaryDirectory(prefix="torture-") as name:
        scratch = Path(name)
        os.chdir(scratch)
        try:
            if options.input is not None:
                kind, _, number = options.input.rpartition(":")
                print(Trial(good_files(scratch), scratch / "damaged")((kind, int(number))))
                return 0
            if options.configuration is not None:
                return once(options.configuration)
            return _all(options, report, scratch, here)
        finally:
            os.chdir(here)


def _all(options: argparse.Namespace, report: ReportSection, scratch: Path, here: Path) -> int:
    """The chosen parts one after the other, and their table; 1 if anything failed."""
    whole = sum(SHARES.get(part, 0.0) for part in options.parts) or 1.0
    done, tables = [], []
    for part in options.parts:
        folder = scratch / part
        folder.mkdir()
        tally, table = run(part, options, options.minutes * SHARES.get(part, 0.0) / whole, folder)
        done.append(tally)
        tables += [table] if table else []
    content = "\n".join(
        [HEAD, *(tally.row() for tally in done), *(f"\n{table}" for table in tables)]
    )
    print(content)
    os.chdir(here)
    if options.json is not None:
        write_json(options.json, {"seed": options.seed, "parts": [tally.plain() for tally in done]})
    report.write(content)
    return int(any(tally.failed for tally in done))


if __name__ == "__main__":
    sys.exit(main())
