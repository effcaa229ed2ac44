"""The leaderboard of ``ganlane benchmark``: tables from committed results, and their check.

    python -m benchmarks.leaderboard                   # what differs in the documents
    python -m benchmarks.leaderboard --write           # write README's table and the page
    python -m benchmarks.leaderboard --add outputs/benchmark/RUN/results.json --name NAME
    python -m benchmarks.leaderboard --check           # drive a part of the samples again
    python -m benchmarks.leaderboard --check --all     # all of them

``--add`` stores what the page needs of a run as ``docs/leaderboard/NAME.json``, and of an agent
that is a folder of stable-baselines3 models or plain networks the layers that act. ``--check``
drives sampled episodes of every agent that can be had here, and refuses those that come out
otherwise: two of each entry on three traffics, drawn by its name; with ``--all`` every one.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias

from benchmarks.script import ROOT, ReportSection, make_parser, markdown, run_script
from ganlane.agents.stored_models import load_model, save_network
from ganlane.build import Driver
from ganlane.config.run import settings
from ganlane.errors import UserError
from ganlane.evaluation.table import Table
from ganlane.files import write_json
from ganlane.settings.suite import BenchmarkConfig
from ganlane.suite.driving import compare
from ganlane.suite.report import score_table
from ganlane.suite.run import SCHEMA, drivers_of
from ganlane.suite.scores import recipe_of

FOLDER = ROOT / "docs" / "leaderboard"
#: Documents, the stored results behind the table in each (None: all), and its columns (None: all).
PAGES: Mapping[str, tuple[str | None, tuple[str, ...] | None]] = {
    "docs/leaderboard.md": (None, None),
    "README.md": (
        "agent_general",
        ("entry", "score [95 %]", "worst traffic", "crashes", "near misses", "P(above MOBIL)"),
    ),
}
#: Of the table in a document.
SECTION = "leaderboard"
#: What is stored of a run's results.
PARTS = ("schema", "suite", "protocol", "quick", "entries", "sample", "code", "machine", "written")
#: Of each entry ``--check`` drives again so many episodes on so many traffics.
EPISODES, TRAFFICS = 2, 3

Results = Mapping[str, Any]
#: Of the first episodes, by driver and traffic.
Rewards: TypeAlias = dict[tuple[str, str], list[float]]


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
    """The table of a document: one line per entry, the best first; drivers of the suite once.

    Of an entry that was driven with one training and with several the latter counts.
    """
    only, columns = PAGES[document]
    driven = []
    for name, content in stored().items():
        if only in (None, name):
            driven += content["entries"]
    entries: dict[str, Results] = {}
    for entry in sorted(driven, key=lambda entry: -entry["trainings"]):
        entries.setdefault(entry["entry"], entry)
    traffics = list(settings("benchmark", []).suite.scored)
    whole = score_table(list(entries.values()), traffics, [])
    # How fast one machine drove is no property of an agent.
    wanted = columns or [name for name in whole.headings if name != "decisions/s"]
    places = [whole.headings.index(name) for name in wanted]
    lines = [[line[place] for place in places] for line in whole.lines]
    return markdown(Table("", list(wanted), lines))


def add(path: Path, name: str) -> str:
    """Store what the page needs of a run, and the weights of agents in folders; names the file.

    Raises:
        UserError: not the results of a benchmark.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        agents = list(content["config"]["agents"] or ())
        parts = {part: content[part] for part in PARTS}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"{path}: not the results.json of ganlane benchmark ({error!r}); give that of a run."
        ) from error
    for number, agent in enumerate(agents):
        folder = Path(agent).resolve()
        for model_file in sorted(folder.glob("*.zip")):
            # The layers that act, without critics and optimisers.
            model, reading = load_model(model_file)
            save_network(FOLDER / folder.name / model_file.name, model.layers, reading)
            agents[number] = folder.name
    file = FOLDER / f"{name}.json"
    write_json(file, {"agents": agents, **parts})
    return f"stored: {file}"


def differences() -> list[str]:
    """Which documents are not as the stored results say."""
    return [
        f"{document}: differs; run `python -m benchmarks.leaderboard --write`."
        for document in PAGES
        if ReportSection(ROOT / document, SECTION).read() != table(document)
    ]


def cells(results: Results, every: bool) -> list[tuple[Driver, str]]:
    """The trainings of a stored run and the traffics on which they are driven again.

    Raises:
        UserError: an agent that is not at hand here.
    """
    config: BenchmarkConfig = settings("benchmark", [])
    agents = results["agents"] or config.suite.agents
    # Weights of a contributor lie beside the results, in a folder of the entry's name.
    beside = [str(FOLDER / agent) if (FOLDER / agent).is_dir() else agent for agent in agents]
    names = [*config.suite.drivers(), *beside]
    entries: dict[str, list[Driver]] = {}
    for driver in drivers_of(list(dict.fromkeys(names)), config):
        entries.setdefault(recipe_of(driver.name), []).append(driver)
    traffics = list(config.suite.scored)
    drawn: list[tuple[Driver, str]] = []
    for entry, trainings in entries.items():
        if every:
            drawn += product(trainings, traffics)
        else:
            # The same for everybody, and another for another entry.
            chance = random.Random(entry)
            drawn += [
                (chance.choice(trainings), name) for name in chance.sample(traffics, TRAFFICS)
            ]
    return drawn


def driven_again(name: str, results: Results, rewards: Rewards, every: bool = False) -> list[str]:
    """Drive sampled episodes of one stored run again: a line for every one that differs.

    Args:
        name: of the stored run.
        results: its content.
        rewards: what was driven before, so that nothing is driven twice; is added to.
        every: all that is stored.
    """
    config: BenchmarkConfig = settings("benchmark", [])
    wrong = []
    for driver, traffic in cells(results, every):
        before = results["sample"].get(driver.name, {}).get(traffic, [])
        if not every:
            before = before[:EPISODES]
        if not before:
            wrong.append(f"{name}: {driver.name} on {traffic} has no sample")
            continue
        cell = driver.name, traffic
        if len(rewards.get(cell, [])) < len(before):
            alone = replace(config.on(traffic), episodes=len(before))
            rewards[cell] = compare([driver], alone, quiet=True)["reward"].to_list()
        for number, (now, then) in enumerate(zip(rewards[cell], before)):
            if now != then:
                wrong.append(
                    f"{name}: {driver.name} on {traffic}, episode {number}: {now}, not {then}"
                )
    return wrong


def work(options: argparse.Namespace) -> str:
    """What is asked for; the line or lines to print."""
    if options.add is not None:
        return add(options.add, options.name)
    if options.check:
        wrong = []
        rewards: Rewards = {}
        for name, results in stored().items():
            try:
                wrong += driven_again(name, results, rewards, options.all)
            except UserError as error:
                print(f"{name}: not driven again ({error})", file=sys.stderr)
        if wrong:
            more = f" ({len(wrong) - 1} more differ)" if len(wrong) > 1 else ""
            raise UserError(f"{wrong[0]}{more}; store what this code drives, or mend the code.")
        return f"{sum(map(len, rewards.values()))} sampled episodes came out as stored"
    for document in PAGES if options.write else ():
        ReportSection(ROOT / document, SECTION).write(table(document))
    return "\n".join(differences()) or "the documents are as the stored results say"


def main(arguments: Sequence[str] | None = None) -> int:
    """Write, add or check; the exit status."""
    parser = make_parser(__doc__)
    parser.add_argument("--write", action="store_true", help="write the page")
    parser.add_argument("--check", action="store_true", help="drive samples again")
    parser.add_argument("--all", action="store_true", help="with --check: every one of them")
    parser.add_argument("--add", type=Path, help="the results.json of a run")
    parser.add_argument("--name", default="mine", help="of the stored file")
    return run_script(work, parser.parse_args(arguments))


if __name__ == "__main__":
    sys.exit(main())
