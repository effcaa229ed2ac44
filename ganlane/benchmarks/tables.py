"""A table as text: aligned for a terminal, or in Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

NOTHING = "-"


@dataclass
class Table:
    """Headings and lines of cells; the first ``names`` columns are words, the others numbers, set to the right."""

    title: str
    headings: Sequence[str]
    lines: Sequence[Sequence[str]]
    names: int = 1
    notes: Sequence[str] = field(default_factory=list)

    def text(self) -> str:
        """Aligned columns, with the notes below."""
        widths = [max(len(line[i]) for line in [self.headings, *self.lines]) for i in range(len(self.headings))]

        def aligned(line: Sequence[str]) -> str:
            cells = [c.ljust(w) if i < self.names else c.rjust(w) for i, (c, w) in enumerate(zip(line, widths))]
            return "  ".join(cells).rstrip()

        ruler = "  ".join("-" * width for width in widths)
        return "\n".join([self.title, "", aligned(self.headings), ruler, *map(aligned, self.lines), *self.notes])

    def markdown(self) -> str:
        """A heading, the table, and the notes below."""
        rulers = ["---" if i < self.names else "---:" for i in range(len(self.headings))]
        lines = ["| " + " | ".join(line) + " |" for line in [self.headings, rulers, *self.lines]]
        parts = [f"### {self.title}", "\n".join(lines)]
        return "\n\n".join([*parts, "\n".join(self.notes)] if self.notes else parts)


def count(value: float | None) -> str:
    """Three significant digits, with k and M: ``612``, ``54.3 k``, ``1.23 M``."""
    if value is None:
        return NOTHING
    for limit, unit in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if abs(value) >= limit * 0.9995:
            return f"{significant(value / limit)}{unit}"
    return significant(value)


def significant(value: float | None) -> str:
    """Three significant digits, without exponent."""
    if value is None:
        return NOTHING
    rounded = float(f"{value:.3g}")
    whole = len(str(int(abs(rounded))))
    return f"{rounded:.{max(0, 3 - whole)}f}" if abs(rounded) >= 1 else f"{rounded:.3g}"


def percent(value: float | None) -> str:
    """A share as whole percents."""
    return NOTHING if value is None else f"{100 * value:.0f} %"
