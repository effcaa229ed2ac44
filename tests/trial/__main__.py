"""Tries to break the package, and counts what held.

    python -m tests.trial --minutes 60 --report docs/reliability.md
    python -m tests.trial kill --minutes 15
    python -m tests.trial damage --input 'scene CSV:17'         a damaged file again
    python -m tests.trial soak --configuration 12               a configuration again

Parts: kill (kill -9, then resumed to the same bits), damage (damaged files), soak (random
configurations). Without a part's name all of them run.
Exits with 1 after a failure. Needs Linux.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.script import ReportSection, add_report, make_parser, run_script

from .damage import Trial, damage, good_files
from .kill import kill
from .soak import once, soak
from .tally import Tally

SECTION = "trial"
#: Parts, and their shares of the minutes.
PARTS = {"kill": (kill, 6), "damage": (damage, 4), "soak": (soak, 8)}
HEAD = "| part | tried | failed | minutes |\n|---|---|---|---|"


def parse() -> argparse.Namespace:
    """The command line."""
    parser = make_parser(__doc__)
    add = parser.add_argument
    add("parts", nargs="*", choices=[[], *PARTS], metavar="PART")
    add("--minutes", type=float, default=10.0, help="of all parts together, about")
    add("--seed", type=int, default=0)
    add("--input", metavar="KIND:NUMBER", help="one damaged file, as a failure names it")
    add("--configuration", type=int, help="one configuration, as a failure names it")
    add_report(parser, SECTION)
    return parser.parse_args()


def attempt(options: argparse.Namespace) -> str:
    """The chosen parts one after the other, and their table; a failure ends the process with 1."""
    # Before the folder changes, which a relative path would not survive.
    document = None if options.report is None else options.report.absolute()
    report = ReportSection(document, SECTION)
    parts = options.parts or list(PARTS)
    share_s = 60.0 * options.minutes / sum(PARTS[part][1] for part in parts)
    with tempfile.TemporaryDirectory(prefix="trial-") as name:
        scratch = Path(name)
        os.chdir(scratch)
        try:
            if options.input is not None:
                kind, _, number = options.input.rpartition(":")
                return Trial(good_files(scratch), scratch / "damaged")((kind, int(number)))
            if options.configuration is not None:
                return once(options.configuration)
            tallies = []
            for part in parts:
                tries, shares = PARTS[part]
                tally = Tally(part)
                folder = scratch / part
                folder.mkdir()
                begun = time.monotonic()
                tries(tally, options.seed, begun + shares * share_s, folder)
                tally.seconds = time.monotonic() - begun
                tallies.append(tally)
        finally:
            os.chdir("/")
    table = "\n".join([HEAD, *(tally.row() for tally in tallies)])
    report.write(table)
    if any(tally.failed for tally in tallies):
        print(table)
        sys.exit(1)
    return table


if __name__ == "__main__":
    sys.exit(run_script(attempt, parse()))
