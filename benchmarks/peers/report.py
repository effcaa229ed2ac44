"""The figures as the tables of docs/peers.md."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

Figures = dict[str, Any]


def page(figures: Figures) -> str:
    """All tables, one below the other."""
    return "\n\n".join(part(figures) for part in PARTS.values())


def fill(text: str, figures: Figures) -> str:
    """``text`` with a new table between every ``<!-- NAME -->`` of :data:`PARTS` and the next ``<!-- end -->``."""

    def replaced(found: re.Match[str]) -> str:
        return f"<!-- {found[1]} -->\n\n{PARTS[found[1]](figures)}\n\n<!-- end -->"

    return re.sub(rf"<!-- ({'|'.join(PARTS)}) -->\n.*?<!-- end -->", replaced, text, flags=re.DOTALL)


def table(head: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def number(value: float) -> str:
    """Four decimals; two significant digits below 0.001; a bound where only rounding is left."""
    if 0.0 < abs(value) < 1e-10:
        return "< 1e-10"
    return f"{value:.1e}" if 0.0 < abs(value) < 1e-3 else f"{value:.4f}"


def traces(figures: Figures) -> str:
    """Largest differences of speed and distance per scene and peer."""
    head = ["scene", "peer", "quantity", "peer - ganlane", "law", "scheme", "allowed for the scheme", "rest"]
    rows = []
    for row in figures["traces"]:
        distance = ("position_m", "position, m") if row["scene"] == "free road" else ("gap_m", "gap, m")
        for key, name in (("speed_mps", "speed, m/s"), distance):
            pieces = [number(row[piece][key]) for piece in ("direct", "law", "scheme", "allowed", "rest")]
            rows.append([row["scene"], row["peer"], name, *pieces])
    return table(head, rows)


def settled(figures: Figures) -> str:
    """Equilibrium gaps per speed and simulator."""
    head = ["speed, m/s", "simulator", "mean gap, m", "formula of its law, m", "largest distance, m", "allowed, m"]
    rows = [
        [
            f"{row['speed_mps']:g}",
            row["simulator"],
            f"{row['gap_m']:.6f}",
            f"{row['formula_m']:.6f}",
            f"{row['away_m']:.1e}",
            f"{row['allowed_m']:.1e}",
        ]
        for row in figures["settled"]
    ]
    return table(head, rows)


def stops(figures: Figures) -> str:
    """Where the cars come to rest behind the obstacle."""
    rows = [[row["simulator"], f"{row['final_gap_m']:.4f}", f"{row['lowest_mps']:.4f}"] for row in figures["stops"]]
    return table(["simulator", "final gap, m", "lowest speed, m/s"], rows)


def steps(figures: Figures) -> str:
    """What other steps do."""
    rows = [[row["other"], *(number(row[key]) for key in ("speed_mps", "gap_m"))] for row in figures["steps"]]
    return table(["ganlane at 0.1 s against", "speed, m/s", "gap, m"], rows)


def versions(figures: Figures) -> str:
    """What the figures were taken with."""
    return ", ".join(f"{name} {version}" for name, version in figures["versions"].items())


PARTS: dict[str, Callable[[Figures], str]] = {
    "traces": traces,
    "settled": settled,
    "stops": stops,
    "steps": steps,
    "versions": versions,
}
