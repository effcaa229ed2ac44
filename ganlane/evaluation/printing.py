"""Tables as text: aligned for a terminal, or in Markdown; and numbers as their cells show them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

NOTHING = "-"


@dataclass(frozen=True)
class Table:
    """A title, headings, lines of cells, and notes.

    The first ``names`` columns hold words and are set to the left, the others hold numbers and are set to the right.
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
        """One line per row; ``columns`` maps each heading to the function that makes a cell of a row."""
        lines = [[cell(row) for cell in columns.values()] for row in rows]
        return cls(title, list(columns), lines, names, notes)

    def text(self) -> str:
        """Aligned columns, with the notes below."""
        widths = [max(len(line[i]) for line in [self.headings, *self.lines]) for i in range(len(self.headings))]

        def aligned(line: Sequence[str]) -> str:
            cells = [c.ljust(w) if i < self.names else c.rjust(w) for i, (c, w) in enumerate(zip(line, widths))]
            return "  ".join(cells).rstrip()

        ruler = "  ".join("-" * width for width in widths)
        return "\n".join([self.title, "", aligned(self.headings), ruler, *map(aligned, self.lines), *self.notes])

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
