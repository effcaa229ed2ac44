"""Tables as text, aligned for a terminal or in Markdown, and the tables of an evaluation."""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Row = Mapping[str, Any]

NOTHING = "-"


def aligned(lines: Sequence[Sequence[str]], names: int = 1) -> str:
    """A text table of headings (the first line) and rows, with a ruler between them.

    The first ``names`` columns are left-aligned, the others right-aligned.
    """
    widths = [max(map(len, column)) for column in zip(*lines)]

    def line(cells: Sequence[str]) -> str:
        fitted = [
            cell.ljust(w) if i < names else cell.rjust(w)
            for i, (cell, w) in enumerate(zip(cells, widths))
        ]
        return "  ".join(fitted).rstrip()

    return "\n".join(
        [line(lines[0]), "  ".join("-" * width for width in widths), *map(line, lines[1:])]
    )


def show(*texts: str, columns: str = "auto") -> None:
    """Print texts, a blank line between them, their tables as wide as the terminal (``columns``
    auto) or whole (all).

    Where the output is no terminal, tables are whole.
    """
    width = (
        shutil.get_terminal_size().columns if columns == "auto" and sys.stdout.isatty() else None
    )
    print("\n\n".join(texts) if width is None else fitting("\n\n".join(texts), width))


def fitting(text: str, width: int) -> str:
    """``text``, without some columns of each table of :func:`aligned` that is wider; a line below
    names them.

    A table ends with a blank line. Columns go from the right, those of :data:`_FIRST_TO_GO` before
    the others.
    """
    return "\n\n".join(_narrowed(part.split("\n"), width) for part in text.split("\n\n"))


def _narrowed(lines: Sequence[str], width: int) -> str:
    ruler = next((at for at, line in enumerate(lines) if re.fullmatch(r"-+(  -+)+", line)), None)
    if ruler is None or len(lines[ruler]) <= width:
        return "\n".join(lines)
    spans = [slice(*found.span()) for found in re.finditer("-+", lines[ruler])]
    names = [lines[ruler - 1][span].strip() for span in spans]
    order = [names.index(name) for name in _FIRST_TO_GO if name in names]
    kept = set(range(len(spans)))
    for column in [*order, *reversed(range(1, len(spans)))]:
        if sum(spans[each].stop - spans[each].start + 2 for each in kept) > width + 2:
            kept.discard(column)
    rows = [
        "  ".join(line[spans[each]] for each in sorted(kept)).rstrip()
        for line in lines[ruler - 1 :]
    ]
    gone = ", ".join(name for each, name in enumerate(names) if each not in kept and name)
    return "\n".join([*lines[: ruler - 1], *rows, f"(columns=all shows: {gone})"])


def number(value: float | None, digits: int = 3) -> str:
    """A cell with a number; ``-`` where there is none."""
    return NOTHING if value is None else f"{value:.{digits}f}"


def with_interval(row: Row, key: str, digits: int = 3) -> str:
    """A cell with ``row[key]``, followed by ``[low, high]`` where the row has an interval for it
    (``key_ci``).
    """
    text, interval = number(row.get(key), digits), row.get(f"{key}_ci")
    return text if not interval else f"{text} [{interval[0]:.{digits}f}, {interval[1]:.{digits}f}]"


@dataclass(frozen=True)
class Table:
    """A title, headings, lines of cells, and notes.

    The first ``names`` columns hold words and are set to the left, the others hold numbers and are
    set to the right.
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
        rows: Sequence[Mapping[str, Any]],
        columns: Mapping[str, Callable[[Any], str]],
        names: int = 1,
        notes: Sequence[str] = (),
    ) -> Table:
        """One line per row.

        ``columns`` maps each heading to the function that makes a cell of a row.
        """
        lines = [[cell(row) for cell in columns.values()] for row in rows]
        return cls(title, list(columns), lines, names, notes)

    def text(self) -> str:
        """Aligned columns, with the notes below."""
        table = aligned([self.headings, *self.lines], self.names)
        return "\n".join([self.title, "", table, *(["", *self.notes] if self.notes else [])])

    def markdown(self, heading: bool = True) -> str:
        """The title as a heading (unless turned off), the table, and the notes below."""
        rulers = ["---" if i < self.names else "---:" for i in range(len(self.headings))]
        lines = ["| " + " | ".join(line) + " |" for line in [self.headings, rulers, *self.lines]]
        parts = [*([f"### {self.title}"] if heading else []), "\n".join(lines)]
        return "\n\n".join([*parts, "\n".join(self.notes)] if self.notes else parts)


def significant(value: float | None) -> str:
    """Three significant digits, without exponent."""
    if value is None:
        return NOTHING
    rounded = float(f"{value:.3g}")
    whole = len(str(int(abs(rounded))))
    return f"{rounded:.{max(0, 3 - whole)}f}" if abs(rounded) >= 1 else f"{rounded:.3g}"


def count(value: float | None) -> str:
    """Three significant digits, with k, M and G: ``612``, ``54.3 k``, ``1.23 M``."""
    if value is None:
        return NOTHING
    for limit, unit in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if abs(value) >= limit * 0.9995:
            return f"{significant(value / limit)}{unit}"
    return significant(value)


def percent(share: float | None, digits: int = 0) -> str:
    """A share as per cent."""
    return NOTHING if share is None else f"{100 * share:.{digits}f} %"


#: Heading, key and digits of each column of an evaluation, names before numbers; ``run``: of a
#: sweep.
_COLUMNS: Mapping[str, tuple[str, int | None]] = {
    **{name: (name, None) for name in ("run", "agent", "traffic", "episodes", "goal")},
    "hard": ("hard_crash", None),
    "soft": ("soft_crash", None),
    "off road": ("out_of_road", None),
    "time-out": ("timeout", None),
    "scene end": ("scene_end", None),
    "mean reward [95 %]": ("mean_reward", 1),
    "minus MOBIL, paired": ("minus_mobil", 1),
    "m/s": ("mean_speed_mps", 1),
    "changes/km": ("lane_changes_per_km", 2),
    "% of MOBIL [95 %]": ("normalized_percent", 0),
    "crashes/1000 km [95 %]": ("crashes_per_1000_km", 1),
}
#: Columns that are left out where no row has anything in them.
_OPTIONAL = ("run", "time-out", "scene end", "minus MOBIL, paired")
#: Columns that a narrow terminal does without, the least telling first; the paired leads have a
#: table of their own.
_FIRST_TO_GO = (
    *(
        "crashes/1000 km [95 %]",
        "% of MOBIL [95 %]",
        "changes/km",
        "minus MOBIL, paired",
        "episodes",
    ),
    *("time-out", "scene end", "soft", "m/s", "goal"),
)


def text_table(rows: Sequence[Row]) -> str:
    """The rows of :func:`ganlane.evaluation.evaluation_rows`, and a line for each reason why a
    score is missing.
    """
    cells = {
        heading: [
            str(row.get(key, NOTHING)) if digits is None else with_interval(row, key, digits)
            for row in rows
        ]
        for heading, (key, digits) in _COLUMNS.items()
    }
    cells = {
        name: column
        for name, column in cells.items()
        if name not in _OPTIONAL or {*column} - {"0", NOTHING}
    }
    reasons: dict[str, dict[str, None]] = {}
    for row in rows:
        reason = row.get("normalized_percent_reason")
        if reason is not None:
            reasons.setdefault(reason, {})[row["traffic"]] = None
    notes = [
        f"% of MOBIL on {', '.join(traffics)}: none, {reason}"
        for reason, traffics in reasons.items()
    ]
    table = aligned([list(cells), *map(list, zip(*cells.values()))], 2 + ("run" in cells))
    return "\n".join([table, *(["", *notes] if notes else [])])


def paired_table(rows: Sequence[Row]) -> str:
    """The rows of :func:`ganlane.evaluation.paired_rows`, each lead with its sign."""
    lines = [["paired lead", "traffic", "reward [95 %]", "verdict"]]
    for row in rows:
        sign = "" if row["lead"] < 0.0 else "+"
        lead = sign + with_interval(row, "lead", 1)
        lines.append([f"{row['agent']} over {row['over']}", row["traffic"], lead, row["verdict"]])
    return aligned(lines, names=2)
