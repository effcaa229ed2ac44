"""The tables of README and docs that the matrix gives, and a check of the numbers printed around
them.

    python -m benchmarks.printed          # print what is not as the results say
    python -m benchmarks.printed outputs/benchmark/RUN/results.json --write

Tables stand between ``<!-- begin matrix NAME -->`` and ``<!-- end matrix NAME -->``. A test makes
them again from ``docs/reproduce/results.json`` and from those of :data:`FURTHER`; it also looks up
every figure with an interval, such as ``14.0 [3.2, 25.6]``, in the sections of :data:`CHECKED`.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.script import ROOT, ReportSection, make_parser, markdown, run_script
from ganlane.errors import UserError
from ganlane.evaluation.table import Table, with_interval, with_sign
from ganlane.suite.report import PAPER_VI, PAPER_VII

RESULTS = ROOT / "docs" / "reproduce" / "results.json"
#: Folders below it with further results: ``ganlane benchmark`` with the control trainings,
#: agent_general over more episodes and on traffics that are not the project's own, agent_human, and
#: the missions (suite=exit-v1 and merge-v1); other roads and ablations are of scripts of revision
#: 878329b.
FURTHER = ("controls", "general", "human", "roads", "elsewhere", "ablations", "exit", "merge")
#: Drivers of the matrix by their names in a document.
DRIVERS: Mapping[str, str] = {
    "agent_general+safe": "agent_general",
    "agent_idm+none": "Agent_IDM",
    "agent_gan+none": "Agent_GAN",
    "agent_idm_long+none": "Agent_IDM, 3 M longer",
    "agent_idm+safe": "Agent_IDM behind `safe`",
    "agent_gan+safe": "Agent_GAN behind `safe`",
    "mobil_egoistic": "egoistic MOBIL",
    "keep_lane": "keeping the lane",
    "random_legal": "random legal",
}
#: Control trainings.
CONTROLS: Mapping[str, str] = {
    "agent_gan_only+none": "`gan` alone, 13 M",
    "agent_idm_table3+none": "Agent_IDM with Table III",
    "agent_gan_table3+none": "Agent_GAN with Table III",
}
#: Traffics that the recipes of learning drivers were trained on.
TRAINED_ON: Mapping[str, Sequence[str]] = {
    "agent_general": ("idm", "idm_mobil", "idm_random", "gan"),
    "agent_idm": ("idm_mobil",),
    "agent_gan": ("idm_mobil", "gan"),
    "agent_idm_long": ("idm_mobil",),
    "agent_gan_only": ("gan",),
    "agent_idm_table3": ("idm_mobil",),
    "agent_gan_table3": ("idm_mobil", "gan"),
}
#: Differences of the page on the paper's claim: first, second, and what the line is called.
CLAIMS = (
    ("agent_idm+none", "mobil", "Agent_IDM over MOBIL"),
    ("agent_gan+none", "mobil", "Agent_GAN over MOBIL"),
    ("agent_gan+none", "agent_idm+none", "Agent_GAN over Agent_IDM"),
    ("agent_gan+safe", "agent_idm+safe", "the same, both behind `safe`"),
    ("agent_idm_long+none", "agent_idm+none", "Agent_IDM 3 M longer over Agent_IDM"),
    ("agent_gan+none", "agent_idm_long+none", "Agent_GAN over Agent_IDM 3 M longer"),
    ("agent_general+safe", "agent_idm+safe", "agent_general over Agent_IDM behind `safe`"),
    ("agent_general+safe", "agent_gan+safe", "agent_general over Agent_GAN behind `safe`"),
)
#: Differences between these and the paper's agents, as :data:`CLAIMS`.
CONTROL_CLAIMS = (
    ("agent_gan+none", "agent_gan_only+none", "Agent_GAN over `gan` alone"),
    ("agent_idm_table3+none", "agent_idm+none", "Agent_IDM with Table III over Agent_IDM"),
    ("agent_gan_table3+none", "agent_gan+none", "Agent_GAN with Table III over Agent_GAN"),
    (
        "agent_gan_table3+none",
        "agent_idm_table3+none",
        "Agent_GAN over Agent_IDM, both with Table III",
    ),
)
#: The difference that is shown beside agent_human, as :data:`CLAIMS`.
HUMAN_CLAIMS = (("agent_human", "mobil_egoistic", "agent_human over the egoistic MOBIL"),)
#: Sections whose figures are looked up: document, and the heading of the section (None: all of it).
CHECKED = (
    ("README.md", "## Results"),
    ("docs/drivers.md", "## The matrix"),
    ("docs/drivers.md", "## The paper's claims"),
    ("docs/drivers.md", "## Controls"),
    ("docs/drivers.md", "## Other roads"),
    ("docs/drivers.md", "## Recordings, other simulators, individual drivers"),
    ("docs/drivers.md", "## What each part is worth"),
    ("docs/drivers.md", "## agent_general over trainings"),
    ("docs/drivers.md", "## agent_human"),
    ("docs/scenarios.md", "## Trained agents"),
)
_INTERVAL = re.compile(r"([-+]?\d+(?:\.\d+)?) \[(-?\d+(?:\.\d+)?), (-?\d+(?:\.\d+)?)\]")

Results = Mapping[str, Any]
Row = Mapping[str, Any]
#: Value, low, high, and the digits behind the point that they are printed with.
Figure = tuple[float, ...]


def at(results: Results, driver: str, traffic: str) -> Row:
    """The row of a driver on a traffic."""
    return next(
        row for row in results["rows"] if (row["driver"], row["traffic"]) == (driver, traffic)
    )


def _traffics(results: Results) -> list[str]:
    return list(results["seeds"]["episodes"])


def _episodes(row: Row) -> int:
    """Of all trainings."""
    return int(row["trainings"] * row["episodes"])


def _lead(row: Row) -> str:
    """Lead over MOBIL; italics: a learning driver's on traffic that it was not trained on."""
    text = with_sign(row, "minus_mobil", 1)
    trained_on = TRAINED_ON.get(row["driver"].partition("+")[0])
    return text if trained_on is None or row["traffic"] in trained_on else f"*{text}*"


def _failures(row: Row) -> str:
    return f"{row['hard_crash']}, {row['out_of_road']}"


def _lead_and_failures(row: Row, lead: str = "minus_mobil") -> str:
    return f"{with_sign(row, lead, 1)}; {_failures(row)}"


def _mean_and_failures(row: Row) -> str:
    return f"({row['mean_reward']:.1f}); {_failures(row)}"


def _by_traffic(results: Results, first: str, lines: Sequence[Sequence[str]]) -> str:
    """Lines of a name and a cell for every traffic."""
    headings = [first, *(f"`{traffic}`" for traffic in _traffics(results))]
    return markdown(Table("", headings, lines))


def _lines(
    results: Results, names: Mapping[str, str], cell: Callable[[Row], str]
) -> list[list[str]]:
    """For every driver its name, and a cell for every traffic."""
    return [
        [name, *(cell(at(results, driver, traffic)) for traffic in _traffics(results))]
        for driver, name in names.items()
    ]


def leads(results: Results) -> str:
    """Drivers by traffics: paired lead over MOBIL."""
    names = {driver: name for driver, name in DRIVERS.items() if driver != "random_legal"}
    table = _by_traffic(results, "lead over MOBIL", _lines(results, names, _lead))
    means = ", ".join(
        f"{at(results, 'mobil', traffic)['mean_reward']:.1f} on `{traffic}`"
        for traffic in _traffics(results)
    )
    return f"{table}\n\nMOBIL's own mean reward: {means}."


def failures(results: Results) -> str:
    """Drivers by traffics: crashes and departures in all episodes of all trainings."""

    def cell(row: Row) -> str:
        return f"{_failures(row)} of {_episodes(row)}"

    lines = _lines(results, {"mobil": "MOBIL", **DRIVERS}, cell)
    return _by_traffic(results, "hard crashes, departures", lines)


def _differences(results: Results, pairs: Sequence[tuple[str, str, str]]) -> list[list[str]]:
    """Lines with the lead of one driver over another by traffics.

    Pairs that are not in the results are left out.
    """
    lines = []
    for first, second, name in pairs:
        leads = {
            row["traffic"]: with_sign(row, "lead", 1)
            for row in results["comparisons"]
            if (row["driver"], row["over"]) == (first, second)
        }
        if leads:
            lines.append([name, *(leads[traffic] for traffic in _traffics(results))])
    return lines


def claims(results: Results) -> str:
    """Pairs of :data:`CLAIMS` by traffics."""
    return _by_traffic(results, "lead", _differences(results, CLAIMS))


def paper(results: Results) -> str:
    """The paper's Tables VI and VII, each number beside ours."""
    lines = []
    for agent in ("agent_idm", "agent_gan"):
        ours = [at(results, f"{agent}+none", traffic) for traffic in ("idm", "idm_mobil", "gan")]
        crashes = [f"{row['hard_crash']}, {row['soft_crash']} of {_episodes(row)}" for row in ours]
        percent, reward, spread = PAPER_VII[agent]
        row = ours[-1]
        score = with_interval(row, "normalized_percent", 1)
        lines.append(
            [
                DRIVERS[f"{agent}+none"],
                ", ".join(PAPER_VI[agent]),
                *crashes[:-1],
                f"{percent} %; {reward} ({spread})",
                f"{score} %; {row['mean_reward']:.1f} ({row['reward_sd']:.1f})",
            ]
        )
    headings = [
        "",
        "VI, hard and soft crashes: the paper, Traffic_IDM",
        "here, `idm`",
        "here, `idm_mobil`",
        "VII, % of MOBIL; reward (its standard deviation): the paper, Traffic_GAN",
        "here, `gan`",
    ]
    return markdown(Table("", headings, lines))


def controls(results: Results) -> str:
    """Control trainings by traffics.

    Lead over MOBIL and failures, then their differences from the paper's agents.
    """
    part = results["controls"]

    def cell(row: Row) -> str:
        return f"{_lead(row)}; {_failures(row)}"

    lines = _lines(part, CONTROLS, cell) + _differences(part, CONTROL_CLAIMS)
    return _by_traffic(part, "lead; crashes, departures", lines)


def trainings(results: Results) -> str:
    """agent_general training by training, then all of them: lead over MOBIL, and failures."""
    part = results["general"]
    together = [at(part, "agent_general+safe", traffic) for traffic in _traffics(part)]
    lines = [
        [f"`{training[0]['driver'].removesuffix('+safe')}`", *map(_lead_and_failures, training)]
        for training in zip(*(row["each"] for row in together))
    ]
    lines.append(["together", *map(_lead_and_failures, together)])
    lines += _lines(part, {"mobil": "MOBIL (its mean reward)"}, _mean_and_failures)
    return _by_traffic(part, "lead; crashes, departures", lines)


def readme(results: Results) -> str:
    """README's table: lead over MOBIL and hard crashes per 1000 episodes."""

    def cell(row: Row) -> str:
        ours, mobils = (
            1000 * driven["hard_crash"] / _episodes(driven)
            for driven in (row, at(results, "mobil", row["traffic"]))
        )
        return f"{_lead(row)}, {ours:.0f} ({mobils:.0f})"

    drivers = ["agent_general+safe", "agent_idm+none", "agent_gan+none", "mobil_egoistic"]
    names = {driver: DRIVERS[driver] for driver in drivers}
    return _by_traffic(results, "driver", _lines(results, names, cell))


def roads(results: Results) -> str:
    """Drivers by roads, traffic by traffic: lead over MOBIL, and failures."""
    places: dict[str, None] = {}
    lines: dict[str, list[str]] = {}
    for row in results["roads"]["rows"]:
        places[f"{row['vehicles']} on {row['lanes']}"] = None
        if row["driver"] != "mobil":
            name = f"{DRIVERS[row['driver']]}, `{row['traffic']}`"
            lines.setdefault(name, [name]).append(_lead_and_failures(row))
    return markdown(Table("", ["lead; crashes, departures", *places], list(lines.values())))


def elsewhere(results: Results, name: str = "elsewhere") -> str:
    """Drivers by further traffics: lead over MOBIL, and failures."""
    part = results[name]
    there = {row["driver"] for row in part["rows"]}
    names = {"agent_human": "agent_human", **DRIVERS}
    names = {driver: named for driver, named in names.items() if driver in there}
    lines = [
        ["episodes of each training", *map(str, part["seeds"]["episodes"].values())],
        *_lines(part, {"mobil": "MOBIL (its mean reward)"}, _mean_and_failures),
        *_lines(part, names, _lead_and_failures),
        *_differences(part, HUMAN_CLAIMS),
    ]
    return _by_traffic(part, "lead; crashes, departures", lines)


def missions(results: Results, name: str) -> str:
    """Drivers by traffics on a road with an exit or a lane that ends.

    Lead over MOBIL (its mean reward); goals, crashes, missed exits and time-outs of all episodes,
    in per cent; mean time until the goal, s.
    """
    part = results[name]

    def cell(row: Row) -> str:
        ends = ("goal", "hard_crash", "missed_exit", "timeout")
        shares = ", ".join(f"{100 * row[end] / _episodes(row):.1f}" for end in ends)
        is_mobil = row["minus_mobil"] is None
        lead = f"({row['mean_reward']:.1f})" if is_mobil else with_sign(row, "minus_mobil", 1)
        return f"{lead}; {shares}; {row['goal_s']:.0f}" if row["goal"] else f"{lead}; {shares}"

    # How random drivers and those without a mission end is told in a sentence.
    names = {
        row["driver"]: f"`{row['driver']}`"
        for row in part["rows"]
        if row["driver"] not in ("random_legal", "keep_lane")
    }
    lines = _lines(part, names, cell)
    return _by_traffic(part, "lead; goal, crash, missed, time-out, %; s", lines)


def ablations(results: Results) -> str:
    """Trainings with one thing changed by traffics.

    Lead over the one without a change, and failures.
    """
    part = results["ablations"]
    leads = {(row["driver"], row["traffic"]): row for row in part["comparisons"]}

    def cell(row: Row) -> str:
        lead = leads.get((row["driver"], row["traffic"]))
        return (
            _mean_and_failures(row) if lead is None else _lead_and_failures({**row, **lead}, "lead")
        )

    names = {
        name: f"`{' '.join(changed)}`" if changed else "nothing (its mean reward)"
        for name, changed in part["changed"].items()
    }
    lines = _lines(part, names, cell)
    return _by_traffic(part, "changed: lead; crashes, departures", lines)


#: Document and name of the markers to the table between them.
SECTIONS: Mapping[tuple[str, str], Callable[[Results], str]] = {
    ("README.md", "readme"): readme,
    ("docs/drivers.md", "leads"): leads,
    ("docs/drivers.md", "failures"): failures,
    ("docs/drivers.md", "paper"): paper,
    ("docs/drivers.md", "claims"): claims,
    ("docs/drivers.md", "controls"): controls,
    ("docs/drivers.md", "roads"): roads,
    ("docs/drivers.md", "elsewhere"): elsewhere,
    ("docs/drivers.md", "ablations"): ablations,
    ("docs/drivers.md", "trainings"): trainings,
    ("docs/drivers.md", "human"): partial(elsewhere, name="human"),
    ("docs/scenarios.md", "exit"): partial(missions, name="exit"),
    ("docs/scenarios.md", "merge"): partial(missions, name="merge"),
}


def section(text: str, heading: str) -> str:
    """The part of a document from a heading to the next one of its level.

    Raises:
        UserError: there is no such heading.
    """
    level = heading.split()[0]
    match = re.search(
        rf"^{re.escape(heading)}$(.*?)(?=^{level} |\Z)", text, re.MULTILINE | re.DOTALL
    )
    if match is None:
        raise UserError(f"{heading}: no such section; expected it in the document.")
    return match[1]


def _values(node: Any) -> Iterator[tuple[float, float, float]]:
    """Every value of the results with its interval."""
    if isinstance(node, list):
        for item in node:
            yield from _values(item)
    elif isinstance(node, dict):
        for key, value in node.items():
            interval = node.get(f"{key}_ci")
            if interval and value is not None:
                yield (value, *interval)
            yield from _values(value)


def sourced(results: Results) -> set[Figure]:
    """The figures with an interval that the results have, as they may be printed.

    A lead may be told the other way round: ``12 [10, 14]`` below as ``-12 [-14, -10]``.
    """
    sources = [results, *(results[name] for name in FURTHER)]
    values = list(_values([[source["rows"], source.get("comparisons", [])] for source in sources]))
    values += [(-value, -high, -low) for value, low, high in values]
    return {
        (*(float(f"{x:.{digits}f}") for x in value), digits)
        for value in values
        for digits in (0, 1, 2)
    }


def unsourced(text: str, figures: set[Figure]) -> list[str]:
    """Figures with an interval in ``text`` that are none of :func:`sourced`."""
    wrong = []
    for match in _INTERVAL.finditer(text):
        digits = len(match[1].partition(".")[2])
        if (*map(float, match.groups()), digits) not in figures:
            wrong.append(match[0])
    return wrong


def differences(results: Results) -> list[str]:
    """What in the documents is not as the results say, one line each."""
    wrong = []
    for (document, name), table in SECTIONS.items():
        if ReportSection(ROOT / document, f"matrix {name}").read() != table(results):
            wrong.append(
                f"{document}: the table {name} differs; run `python -m benchmarks.printed --write`."
            )
    figures = sourced(results)
    for document, heading in CHECKED:
        text = section((ROOT / document).read_text(encoding="utf-8"), heading)
        wrong += [
            f"{document}, {heading}: {figure} is not in the results."
            for figure in unsourced(text, figures)
        ]
    return wrong


def load(path: Path = RESULTS) -> Results:
    """The results of the matrix, with those of :data:`FURTHER` by name."""
    further = {name: _read(RESULTS.parent / name / RESULTS.name) for name in FURTHER}
    return {**_read(path), **further}


def _read(path: Path) -> Results:
    results: Results = json.loads(path.read_text(encoding="utf-8"))
    return results


def compare_or_write(options: argparse.Namespace) -> str:
    """What differs, after writing the tables if that is asked for."""
    results = load(options.results)
    for (document, name), table in SECTIONS.items() if options.write else ():
        ReportSection(ROOT / document, f"matrix {name}").write(table(results))
    return "\n".join(differences(results)) or "everything printed is as the results say"


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare or write; the exit status."""
    parser = make_parser(__doc__)
    parser.add_argument(
        "results", type=Path, nargs="?", default=RESULTS, help="of ganlane benchmark"
    )
    parser.add_argument("--write", action="store_true", help="put the tables into the documents")
    return run_script(compare_or_write, parser.parse_args(arguments))


if __name__ == "__main__":
    sys.exit(main())
