"""The table of a benchmark, the paper's tables beside ours, and the page with films of failures."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ganlane.evaluation.measures import CRASHES
from ganlane.evaluation.rows import SCALE_BOTTOM, SCALE_TOP
from ganlane.evaluation.table import Cell, Table, number, number_of, text_of, with_interval
from ganlane.files import write_bytes

#: A row of :mod:`ganlane.suite.scores`.
Row = Mapping[str, Any]
#: The paper's Table VI: hard and soft crashes on Traffic_IDM, of an unstated number of runs.
PAPER_VI = {
    "agent_idm": ("19", "2"),
    "agent_gan": ("9", "0"),
}
#: The paper's Table VII: % of MOBIL, mean reward and its standard deviation on Traffic_GAN, 1000
#: runs.
PAPER_VII = {
    "agent_idm": ("5.21", "-22.33", "100.66"),
    "agent_gan": ("114.82", "33.62", "95.19"),
}
#: How the page looks: it loads no other file.
_CSS = """
body { font: 15px/1.5 sans-serif; max-width: 1100px; margin: 2em auto; padding: 0 1em; }
body { color: #262a30 }
table { border-collapse: collapse; font-size: 13px; margin: 1em 0 }
td, th { padding: 2px 9px; text-align: right }
th { border-bottom: 1px solid #6e747c }
th[scope] { border: 0; font-weight: normal; text-align: left }
iframe { width: 100%; height: 640px; border: 1px solid #c8ccd2 }
.wide { overflow-x: auto }
"""


def _trainings(row: Row) -> str:
    """A cell with the trainings, and the episodes that each of them drove."""
    return f"{row['trainings']} x {row['episodes']}"


def _kinds(row: Row) -> str:
    """A cell with the numbers of crashes, by how they came about, in the order of ``CRASHES``."""
    return "/".join(str(row["crash_kinds"][kind]) for kind in CRASHES)


def score_table(summaries: Sequence[Row], traffics: Sequence[str], notes: Sequence[str]) -> Table:
    """Every entry with its score; the best first.

    Args:
        summaries: of :func:`ganlane.suite.scores.summaries`, with ``decisions_per_s``.
        traffics: names of the traffics of the score; a column each.
        notes: lines below the table.
    """

    def worst(row: Row) -> str:
        score = number(row["worst"], 1)
        traffic = row["worst_traffic"] or ""
        return f"{score} {traffic}".rstrip()

    def above_mobil(row: Row) -> str:
        # MOBIL itself has no such probability.
        return with_interval(row["improvement"].get("mobil", {}), "probability", 2)

    # Without intervals, which would make the table too wide.
    def rate(name: str) -> Cell:
        return lambda row: number(row[f"{name}_per_1000_km"], 1)

    def on(traffic: str) -> Cell:
        return lambda row: number(row["by_traffic"][traffic]["normalized_percent"], 1)

    # Numbers are of all traffics of the score together, but for the last columns.
    columns = {
        "entry": text_of("entry"),
        "n": text_of("trainings"),
        "score [95 %]": number_of("score", 1),
        "worst traffic": worst,
        "crashes": number_of("crashes_per_1000_km", 1),
        "off road": rate("departures"),
        "at fault": rate("at_fault"),
        "near misses": rate("near_misses"),
        "m/s": number_of("mean_speed_mps", 1),
        "P(above MOBIL)": above_mobil,
        "headway s": number_of("least_headway_s", 2),
        "braking": number_of("hardest_braking_mps2", 1),
        "/".join(CRASHES): _kinds,
        "decisions/s": number_of("decisions_per_s", 0),
    }
    for traffic in traffics:
        columns[traffic] = on(traffic)

    # A higher score is better.
    best_first = sorted(summaries, key=lambda row: -row["score"])
    return Table.of("", best_first, columns, 1, notes)


def matrix_table(rows: Sequence[Row]) -> Table:
    """Every driver on every traffic; ``rows`` of :func:`ganlane.suite.scores.rows`."""
    columns = {
        "driver": text_of("driver"),
        "traffic": text_of("traffic"),
        "episodes": _trainings,
        "score": number_of("normalized_percent", 1),
        "mean reward": number_of("mean_reward", 1),
        "minus MOBIL": number_of("minus_mobil", 1),
        "P(above MOBIL)": number_of("probability_above_mobil", 2),
        "goal": text_of("goal"),
        "goal s": number_of("goal_s", 1),
        "exit missed": text_of("missed_exit"),
        "time-out": text_of("timeout"),
        "hard": text_of("hard_crash"),
        "off road": text_of("out_of_road"),
        "both per 1000 km": number_of("failures_per_1000_km", 1),
        "/".join(CRASHES): _kinds,
        "near misses per 1000 km": number_of("near_misses_per_1000_km", 1),
        "headway s": number_of("least_headway_s", 2),
        "m/s": number_of("mean_speed_mps", 1),
        "changes/km": number_of("lane_changes_per_km", 2),
        "close behind": number_of("soft_crash_behind_per_episode", 2),
    }
    # Most traffics have no exit, and most drivers arrive in time.
    optional = ("exit missed", "time-out")
    return Table.of(
        "Every driver on every traffic",
        rows,
        columns,
        names=2,
        optional=optional,
    )


def comparison_table(rows: Sequence[Row]) -> Table:
    """Pairs of drivers on the same episodes.

    ``rows`` are those of :func:`ganlane.suite.scores.comparisons`.
    """

    # For each training: in how many episodes it or the other crashed alone, and McNemar's p.
    def tests(row: Row) -> str:
        cells = []
        for test in row["mcnemar"]:
            crashed_alone = f"{test['only_first']}/{test['only_second']}"
            cells.append(f"{crashed_alone}, {test['p_value']:.2g}")
        return "; ".join(cells)

    columns = {
        "driver": text_of("driver"),
        "over": text_of("over"),
        "traffic": text_of("traffic"),
        "lead in reward": number_of("lead", 1),
        "P(improvement)": number_of("probability", 2),
        "crashes per 1000 episodes, more": number_of("crash_difference_per_1000_episodes", 1),
        "McNemar, each training: crashed alone, p": tests,
    }
    return Table.of("Drivers compared on the same episodes", rows, columns, names=3)


def paper_tables(rows: Sequence[Row]) -> list[Table]:
    """The paper's Tables VI and VII with our rows below its own.

    ``rows`` are those of :func:`ganlane.suite.scores.rows`. No table where none of the paper's
    agents drove on generated traffic.
    """

    def each(key: str, digits: int) -> Cell:
        return lambda row: ", ".join(number(training[key], digits) for training in row["each"])

    def beside(
        title: str,
        paper: list[list[str]],
        traffics: list[str],
        columns: Mapping[str, Cell],
    ) -> Table:
        """The ``paper``'s lines, and below them our rows on these ``traffics``."""
        ours = [row for row in rows if row["traffic"] in traffics and row["driver"] in drivers]
        table = Table.of(title, ours, {**names, **columns}, 3)
        return replace(table, lines=[*paper, *table.lines])

    # Agents may say that they drive without a mask.
    agents = [*PAPER_VI, *(f"{agent}+none" for agent in PAPER_VI)]
    drivers = [*agents, SCALE_TOP, SCALE_BOTTOM]
    if not any(row["traffic"] == "gan" and row["driver"] in agents for row in rows):
        return []

    # What both tables begin with; the paper's lines have the same.
    names = {
        "source": lambda row: "here",
        "traffic": text_of("traffic"),
        "driver": text_of("driver"),
        "episodes": _trainings,
    }
    # Table VI: counts of all trainings together, and of each alone.
    crashes = {
        "hard": text_of("hard_crash"),
        "soft": text_of("soft_crash"),
        "share of hard [95 %, exact]": number_of("hard_crash_share", 4),
        "each training": each("hard_crash", 0),
    }
    # Table VII: means over all trainings, and of each alone.
    rewards = {
        "% of MOBIL": number_of("normalized_percent", 1),
        "mean reward": number_of("mean_reward", 1),
        "sd": number_of("reward_sd", 1),
        "each training": each("mean_reward", 1),
    }

    # Columns that the paper does not have stay empty in its lines.
    lines_vi = [
        ["paper", "Traffic_IDM", name, "not stated", *counts, "", ""]
        for name, counts in PAPER_VI.items()
    ]
    lines_vii = [
        ["paper", "Traffic_GAN", name, "1000", *values, ""] for name, values in PAPER_VII.items()
    ]

    return [
        beside(
            "Table VI: crashes on rule-driven traffic",
            lines_vi,
            ["idm", "idm_mobil"],
            crashes,
        ),
        beside(
            "Table VII: performance on generated traffic",
            lines_vii,
            ["gan"],
            rewards,
        ),
    ]


def write_report(
    folder: Path,
    title: str,
    tables: Sequence[Table],
    intro: Sequence[str],
    films: Mapping[str, str],
) -> Path:
    """Write ``report.html``, one page that opens without a network; its path.

    Args:
        folder: where the page goes.
        title: its heading.
        tables: one below the other.
        intro: paragraphs above them.
        films: whole pages of the player by their heading; below the tables.
    """
    parts = [f"<p>{html.escape(line)}</p>" for line in intro]
    parts += map(_html, tables)
    for heading, film in films.items():
        # A page within the page: the player keeps its own style, scripts and policy.
        frame = f'<iframe sandbox="allow-scripts" srcdoc="{html.escape(film)}"></iframe>'
        parts.append(f"<h2>{html.escape(heading)}</h2>{frame}")

    escaped_title = html.escape(title)
    body = "".join(parts)
    page = (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        f"<title>{escaped_title}</title><style>{_CSS}</style>"
        f"<h1>{escaped_title}</h1>{body}</html>\n"
    )
    write_bytes(folder / "report.html", page.encode())
    return folder / "report.html"


def _html(table: Table) -> str:
    """A table with its heading above and its notes below, as part of a page."""

    # Everything is escaped: names of drivers and traffics come from the user.
    def cells(before: str, texts: Sequence[str], after: str) -> str:
        return "".join(f"{before}{html.escape(text)}{after}" for text in texts)

    headings = cells("<th>", table.headings, "</th>")
    lines = [f"<tr>{headings}</tr>"]
    for line in table.lines:
        # The columns with names are headings of their line.
        names = cells('<th scope="row">', line[: table.names], "</th>")
        numbers = cells("<td>", line[table.names :], "</td>")
        lines.append(f"<tr>{names}{numbers}</tr>")

    title = html.escape(table.title)
    # A wide table scrolls by itself, not the whole page.
    body = f'<div class="wide"><table>{"".join(lines)}</table></div>'
    notes = cells("<p>", table.notes, "</p>")
    return f"<h2>{title}</h2>{body}{notes}"
