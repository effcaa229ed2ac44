"""An evaluation's rows as text: aligned for a terminal, or as a Markdown table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

Row = dict[str, Any]
Cells = list[str]

_NOTHING = "-"


def _number(key: str, digits: int) -> Callable[[Row], str]:
    """A cell with ``row[key]``, and ``[low, high]`` behind it where the row has an interval for it."""

    def cell(row: Row) -> str:
        value, interval = row.get(key), row.get(f"{key}_ci")
        if value is None:
            return _NOTHING
        text = f"{value:.{digits}f}"
        return text if interval is None else f"{text} [{interval[0]:.{digits}f}, {interval[1]:.{digits}f}]"

    return cell


def _plain(key: str) -> Callable[[Row], str]:
    """A cell with a name or a count as it is."""
    return lambda row: str(row.get(key, _NOTHING))


#: Heading and cell of each column; the first two are names, the others numbers.
COLUMNS: tuple[tuple[str, Callable[[Row], str]], ...] = (
    ("agent", _plain("agent")),
    ("traffic", _plain("traffic")),
    ("episodes", _plain("episodes")),
    ("goal", _plain("goal")),
    ("hard", _plain("hard_crash")),
    ("soft", _plain("soft_crash")),
    ("off road", _plain("out_of_road")),
    ("time-out", _plain("timeout")),
    ("scene end", _plain("scene_end")),
    ("mean reward [95 %]", _number("mean_reward", 1)),
    ("minus MOBIL, paired", _number("minus_mobil", 1)),
    ("m/s", _number("mean_speed_mps", 1)),
    ("changes/km", _number("lane_changes_per_km", 2)),
    ("% of MOBIL [95 %]", _number("normalized_percent", 0)),
    ("crashes/1000 km [95 %]", _number("crashes_per_1000_km", 1)),
)
_NAMES = 2
#: Left out where no row has anything in them.
_OPTIONAL = ("time-out", "scene end", "minus MOBIL, paired")


def _grid(rows: Sequence[Row]) -> tuple[Cells, list[Cells]]:
    """Headings and cells, without the optional columns that hold only zeros."""
    columns = [
        (heading, cell)
        for heading, cell in COLUMNS
        if heading not in _OPTIONAL or any(cell(row) not in ("0", _NOTHING) for row in rows)
    ]
    return [heading for heading, _ in columns], [[cell(row) for _, cell in columns] for row in rows]


def _notes(rows: Sequence[Row]) -> list[str]:
    """One line per reason for which a normalised score is missing, naming the traffics."""
    reasons: dict[str, dict[str, None]] = {}
    for row in rows:
        reason = row.get("normalized_percent_reason")
        if reason is not None:
            reasons.setdefault(reason, {})[row["traffic"]] = None
    return [f"% of MOBIL on {', '.join(traffics)}: none, {reason}" for reason, traffics in reasons.items()]


def text_table(rows: Sequence[Row]) -> str:
    """The rows as aligned columns for a terminal, with a line for each reason why a score is missing."""
    headings, cells = _grid(rows)
    return "\n".join([*_aligned(headings, cells, _NAMES), *_notes(rows)])


def paired_table(rows: Sequence[Row]) -> str:
    """The rows of :func:`ganlane.evaluation.paired_rows` as aligned columns for a terminal."""
    lead = _number("lead", 1)
    cells = [
        [f"{row['agent']} over {row['over']}", row["traffic"], _signed(row["lead"], lead(row)), row["verdict"]]
        for row in rows
    ]
    return "\n".join(_aligned(["paired lead", "traffic", "reward [95 %]", "verdict"], cells, names=2))


def _signed(value: float, text: str) -> str:
    """``text`` of a difference, with a plus where it is one."""
    return text if value < 0.0 else f"+{text}"


def _aligned(headings: Cells, cells: Sequence[Cells], names: int) -> Cells:
    """Lines of a table: headings, a ruler and the rows; the first ``names`` columns to the left, others to the right."""
    widths = [max(len(line[i]) for line in [headings, *cells]) for i in range(len(headings))]

    def aligned(line: Cells) -> str:
        fitted = [cell.ljust(w) if i < names else cell.rjust(w) for i, (cell, w) in enumerate(zip(line, widths))]
        return "  ".join(fitted).rstrip()

    return [aligned(headings), "  ".join("-" * width for width in widths), *(aligned(line) for line in cells)]


def markdown_table(rows: Sequence[Row]) -> str:
    """The rows as a Markdown table, numbers to the right, with the missing scores' reasons below it."""
    headings, cells = _grid(rows)
    rulers = ["---" if i < _NAMES else "---:" for i in range(len(headings))]
    lines = ["| " + " | ".join(line) + " |" for line in [headings, rulers, *cells]]
    notes = _notes(rows)
    return "\n".join([*lines, "", *notes] if notes else lines)
