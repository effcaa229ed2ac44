"""Tables as text, aligned for a terminal or in Markdown, and the tables of an evaluation."""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ganlane.evaluation.rows import FEWEST_EPISODES

#: What a line of a table is made of.
Row = Mapping[str, Any]
#: Makes a cell of a row.
Cell = Callable[[Any], str]

#: A cell without anything to say.
NOTHING = "-"


def aligned(lines: Sequence[Sequence[str]], names: int = 1) -> str:
    """A text table of headings and rows, with a ruler between them.

    Args:
        lines: cells of the headings, then of each row, all of one length.
        names: so many columns, from the left, are left-aligned, the others right-aligned.
    """
    # A column is as wide as its widest cell, the heading included.
    widths = [max(map(len, column)) for column in zip(*lines)]

    def line(cells: Sequence[str]) -> str:
        words = [cell.ljust(width) for cell, width in zip(cells[:names], widths)]
        numbers = [cell.rjust(width) for cell, width in zip(cells[names:], widths[names:])]
        return "  ".join([*words, *numbers]).rstrip()

    # Two spaces between columns, in the ruler too: fitting() finds the columns by it.
    ruler = "  ".join("-" * width for width in widths)
    return "\n".join([line(lines[0]), ruler, *map(line, lines[1:])])


def show(*texts: str, columns: str = "auto") -> None:
    """Print texts, a blank line between them.

    Args:
        texts: with tables of :func:`aligned` among their lines.
        columns: ``auto``: tables are as wide as the terminal, and whole where the output is none;
            ``all``: they are whole.
    """
    text = "\n\n".join(texts)
    # A file or a pipe gets all columns.
    if columns == "auto" and sys.stdout.isatty():
        text = fitting(text, shutil.get_terminal_size().columns)
    print(text)


def fitting(text: str, width: int) -> str:
    """``text``, without some columns of each table of :func:`aligned` that is wider than ``width``.

    A table ends with a blank line; a line below it names what is left out. Columns go from the
    right, those of :data:`_FIRST_TO_GO` before the others.
    """
    parts = text.split("\n\n")
    return "\n\n".join(_narrowed(part.split("\n"), width) for part in parts)


def _narrowed(lines: Sequence[str], width: int) -> str:
    """The part of a text with these ``lines``, made as narrow as :func:`fitting` says."""
    # The ruler below the headings tells a table from other text, and where its columns stand.
    rulers = [place for place, line in enumerate(lines) if re.fullmatch(r"-+(  -+)+", line)]
    if not rulers or len(lines[rulers[0]]) <= width:
        return "\n".join(lines)

    # Where each column stands in a line, by its heading.
    head = rulers[0] - 1
    spans: dict[str, slice] = {}
    for ruler in re.finditer("-+", lines[head + 1]):
        span = slice(*ruler.span())
        heading = lines[head][span].strip()
        spans[heading] = span

    # Columns go one by one until the rest fits, the least telling first, then from the right. The
    # first, the name, stays.
    shown = dict(spans)
    for name in [*_FIRST_TO_GO, *reversed(list(spans)[1:])]:
        # Two spaces behind each, but for the last.
        needed = sum(span.stop - span.start + 2 for span in shown.values()) - 2
        if needed > width:
            shown.pop(name, None)

    # Every line is cut at the same places.
    narrowed = []
    for line in lines[head:]:
        cells = [line[span] for span in shown.values()]
        narrowed.append("  ".join(cells).rstrip())

    # In the order of the table, so that a reader knows where they would be.
    hidden = ", ".join(name for name in spans if name not in shown)
    return "\n".join([*lines[:head], *narrowed, f"(columns=all shows: {hidden})"])


def number(value: float | None, digits: int = 3) -> str:
    """A cell with a number; ``-`` where there is none."""
    return NOTHING if value is None else f"{value:.{digits}f}"


def with_interval(row: Row, key: str, digits: int = 3) -> str:
    """A cell with a number, and ``[low, high]`` where the row has its interval.

    Args:
        row: holds the number as ``key`` and its interval as ``key_ci``; either may be missing.
        key: the number's.
        digits: behind the point.
    """
    text = number(row.get(key), digits)
    interval = row.get(f"{key}_ci")
    if not interval:
        return text
    low, high = interval
    return f"{text} [{low:.{digits}f}, {high:.{digits}f}]"


def with_sign(row: Row, key: str, digits: int) -> str:
    """:func:`with_interval` of a difference: ``+`` before what is not negative."""
    sign = "" if row[key] < 0.0 else "+"
    return sign + with_interval(row, key, digits)


def text_of(key: str) -> Cell:
    """Makes the cell with ``row[key]`` as it is."""
    return lambda row: str(row.get(key, NOTHING))


def number_of(key: str, digits: int) -> Cell:
    """Makes the cell with the number ``row[key]`` and its interval, if there is one."""
    return lambda row: with_interval(row, key, digits)


@dataclass(frozen=True)
class Table:
    """A table of cells that are texts already.

    Attributes:
        title: stands above; empty for none.
        headings: of the columns.
        lines: the cells of each line, as many as headings.
        names: so many columns, from the left, hold words and are set to the left; the others hold
            numbers and are set to the right.
        notes: lines below.
    """

    title: str
    headings: Sequence[str]
    lines: Sequence[Sequence[str]]
    names: int = 1
    notes: Sequence[str] = ()

    @classmethod
    def of(
        cls,
        title: str,
        rows: Sequence[Any],
        columns: Mapping[str, Cell],
        names: int = 1,
        notes: Sequence[str] = (),
        optional: Sequence[str] = (),
    ) -> Table:
        """A table with one line per row.

        Args:
            title: stands above; empty for none.
            rows: what the cells are made of.
            columns: by heading, what makes a cell of a row.
            names: so many columns hold words.
            notes: lines below.
            optional: headings of columns that are left out where no row has anything in them.
        """
        # Columns that say nothing here make room for those that do; a count of 0 says nothing.
        shown = {}
        for heading, cell in columns.items():
            if heading not in optional or any(cell(row) not in ("0", NOTHING) for row in rows):
                shown[heading] = cell

        lines = [[cell(row) for cell in shown.values()] for row in rows]
        return cls(title, list(shown), lines, names, notes)

    def text(self) -> str:
        """Aligned columns, with the title above and the notes below."""
        # The tables of an evaluation have no title: the command is one.
        lines = [self.title, ""] if self.title else []
        lines.append(aligned([self.headings, *self.lines], self.names))
        if self.notes:
            lines += ["", *self.notes]
        return "\n".join(lines)


#: Columns of an evaluation, names before numbers; ``run``: of a sweep.
_COLUMNS = {
    "run": text_of("run"),
    "agent": text_of("agent"),
    "traffic": text_of("traffic"),
    "episodes": text_of("episodes"),
    "goal": text_of("goal"),
    "hard": text_of("hard_crash"),
    "soft": text_of("soft_crash"),
    "off road": text_of("out_of_road"),
    "exit missed": text_of("missed_exit"),
    "time-out": text_of("timeout"),
    "scene end": text_of("scene_end"),
    "mean reward [95 %]": number_of("mean_reward", 1),
    "minus MOBIL, paired": number_of("minus_mobil", 1),
    "m/s": number_of("mean_speed_mps", 1),
    "changes/km": number_of("lane_changes_per_km", 2),
    "% of MOBIL [95 %]": number_of("normalized_percent", 0),
    "crashes/1000 km [95 %]": number_of("crashes_per_1000_km", 1),
}
#: Columns that are left out where no row has anything in them.
_OPTIONAL = ("run", "exit missed", "time-out", "scene end", "minus MOBIL, paired")
#: Columns that a narrow terminal does without, the least telling first; the paired leads have a
#: table of their own.
_FIRST_TO_GO = (
    "crashes/1000 km [95 %]",
    "% of MOBIL [95 %]",
    "changes/km",
    "minus MOBIL, paired",
    "episodes",
    "time-out",
    "scene end",
    "soft",
    "m/s",
    "goal",
)


def text_table(rows: Sequence[Row]) -> str:
    """The rows of :func:`ganlane.evaluation.evaluation_rows`, also those of a sweep.

    Below them stands a line for each reason why a score is missing, with the traffics on which it
    holds.
    """
    # Each reason with its traffics, once each.
    reasons: dict[str, list[str]] = {}
    for row in rows:
        reason = row.get("normalized_percent_reason")
        traffic = row.get("traffic")
        if reason is not None and traffic not in reasons.setdefault(reason, []):
            reasons[reason].append(str(traffic))

    notes = []
    for reason, traffics in reasons.items():
        notes.append(f"% of MOBIL on {', '.join(traffics)}: none, {reason}")

    # Agent and traffic are words, and the run where there is one.
    names = 2 + any("run" in row for row in rows)
    return Table.of("", rows, _COLUMNS, names, notes, _OPTIONAL).text()


def paired_table(rows: Sequence[Row]) -> str:
    """The rows of :func:`ganlane.evaluation.paired_rows`, each lead with its sign.

    A note says why there is no verdict where episodes are few.
    """
    columns = {
        "paired lead": lambda row: f"{row['agent']} over {row['over']}",
        "traffic": text_of("traffic"),
        "reward [95 %]": lambda row: with_sign(row, "lead", 1),
        "verdict": text_of("verdict"),
    }

    few = any(row["episodes"] < FEWEST_EPISODES for row in rows)
    notes = [f"no verdict below {FEWEST_EPISODES} episodes"] if few else []
    return Table.of("", rows, columns, 2, notes).text()
