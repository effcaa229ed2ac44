"""The leaderboard of ``ganlane benchmark``: tables from committed results, and their check.

    python -m benchmarks.leaderboard                   # what differs in the documents
    python -m benchmarks.leaderboard --write           # write README's table and the page
    python -m benchmarks.leaderboard --add outputs/benchmark/RUN/results.json --name NAME
    python -m benchmarks.leaderboard --check           # drive the samples again

``--add`` stores what the page needs of a run as ``docs/leaderboard/NAME.json``. ``--check`` drives
the sampled episodes of every agent that can be had here, and names those that come out otherwise.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.script import ReportSection, make_parser, run_script, split_at_markers
from ganlane.config.run import settings
from ganlane.errors import UserError
from ganlane.evaluation.table import Table
from ganlane.files import write_json
from ganlane.settings.suite import BenchmarkConfig
from ganlane.suite.driving import compare
from ganlane.suite.report import score_table
from ganlane.suite.run import SAMPLE, SCHEMA, drivers_of

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "leaderboard"
#: Documents, the stored results behind the table in each (None: all), and its columns (None: all).
PAGES: Mapping[str, tuple[str | None, tuple[str, ...] | None]] = {
    "docs/leaderboard.md": (None, None),
    "README.md": (
        "agent_general",
        ("entry", "score [95 %]", "worst traffic", "crashes", "near misses", "P(above MOBIL)"),
    ),
}
MARKERS = ("<!-- leaderboard: begin -->", "<!-- leaderboard: end -->")
#: What is stored of a run's results.
PARTS = ("schema", "suite", "protocol", "quick", "entries", "sample", "code", "machine", "written")

Results = Mapping[str, Any]


def stored() -> dict[str, Results]:
    """The stored results by name.

    Raises:
        UserError: one of another protocol than the suite has now.
    """
    protocol = settings("benchmark", []).protocol()
    files = sorted(FOLDER.glob("*.json"))
    results = {file.stem: json.loads(file.read_text(encoding="utf-8")) for file in files}
    for name, content in results.items():
        if (content.get("schema"), content.get("protocol")) != (SCHEMA, protocol):
            raise UserError(
                f"{name}.json: protocol {content.get('protocol')}, expected {protocol}; run "
                "`ganlane benchmark` without changes to the suite."
            )
    return results


def table(document: str) -> str:
    """The table of a document: one line per entry, the best first; drivers of the suite once."""
    only, columns = PAGES[document]
    results = stored() if only is None else {only: stored()[only]}
    entries = {}
    for name in results:
        for entry in results[name]["entries"]:
            entries.setdefault(entry["entry"], entry)
    traffics = list(settings("benchmark", []).suite.scored)
    rows = [{**entry, "decisions_per_s": None} for entry in entries.values()]
    whole = score_table(rows, traffics, [])
    # How fast one machine drove is no property of an agent.
    wanted = columns or [name for name in whole.headings if name != "decisions/s"]
    places = [whole.headings.index(name) for name in wanted]
    lines = [[line[place] for place in places] for line in whole.lines]
    return Table("", list(wanted), lines).markdown(heading=False)


def add(path: Path, name: str) -> str:
    """Store what the page needs of a run; the line that names the file."""
    content = json.loads(path.read_text(encoding="utf-8"))
    agents = content["config"]["agents"]
    parts = {part: content[part] for part in PARTS}
    file = FOLDER / f"{name}.json"
    write_json(file, {"agents": agents, **parts})
    return f"stored: {file}"


def differences() -> list[str]:
    """Which documents are not as the stored results say."""
    wrong = []
    for document in PAGES:
        before, after = split_at_markers(ROOT / document, *MARKERS)
        whole = (ROOT / document).read_text(encoding="utf-8")
        if whole[len(before) : -len(after)].strip() != table(document):
            wrong.append(f"{document}: differs; run `python -m benchmarks.leaderboard --write`.")
    return wrong


def driven_again(name: str, results: Results, episodes: int = SAMPLE) -> list[str]:
    """Drive the sample of one stored run again: a line for every episode that differs.

    Raises:
        UserError: an agent that is not at hand here.
    """
    config: BenchmarkConfig = settings("benchmark", [])
    agents = results["agents"] or config.suite.agents
    # Weights of a contributor lie beside the results, in a folder of the entry's name.
    beside = [str(FOLDER / agent) if (FOLDER / agent).is_dir() else agent for agent in agents]
    names = [*config.suite.drivers(), *beside]
    wrong = []
    for driver in drivers_of(list(dict.fromkeys(names)), config):
        for traffic, rewards in results["sample"].get(driver.name, {}).items():
            count = min(episodes, len(rewards))
            alone = replace(config.on(traffic), episodes=count)
            evaluated = compare([driver], alone, quiet=True)
            for number, (now, before) in enumerate(zip(evaluated["reward"], rewards)):
                if now != before:
                    wrong.append(
                        f"{name}: {driver.name} on {traffic}, episode {number}: {now}, not {before}"
                    )
    return wrong


def work(options: argparse.Namespace) -> str:
    """What is asked for; the line or lines to print."""
    if options.add is not None:
        return add(options.add, options.name)
    if options.check:
        wrong = []
        for name, results in stored().items():
            try:
                wrong += driven_again(name, results)
            except UserError as error:
                print(f"{name}: not driven again ({error})", file=sys.stderr)
        if wrong:
            raise UserError("; ".join(wrong))
        return "every sampled episode came out as stored"
    for document in PAGES if options.write else ():
        ReportSection(ROOT / document, *MARKERS).write(f"\n{table(document)}\n")
    return "\n".join(differences()) or "the documents are as the stored results say"


def main(arguments: Sequence[str] | None = None) -> int:
    """Write, add or check; the exit status."""
    parser = make_parser(__doc__)
    parser.add_argument("--write", action="store_true", help="write the page")
    parser.add_argument("--check", action="store_true", help="drive the samples again")
    parser.add_argument("--add", type=Path, help="the results.json of a run")
    parser.add_argument("--name", default="mine", help="of the stored file")
    return run_script(work, parser.parse_args(arguments))


if __name__ == "__main__":
    sys.exit(main())
