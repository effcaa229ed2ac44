"""The figures of the comparison as the tables of docs/peers.md and as a plot of four panels."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.peers.scene import OBSTACLE, SLOW_AND_GO, Scheme, Trace, equilibrium_gap
from benchmarks.peers.tolerance import difference
from benchmarks.script import markdown
from ganlane.evaluation.table import Table
from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.idm import TABLE_V
from ganlane.view.figures import COLOURS, INK, STYLE, save_figure

Figures = dict[str, Any]


def page(figures: Figures) -> str:
    """All tables, one below the other."""
    return "\n\n".join(part(figures) for part in PARTS.values())


def fill(text: str, figures: Figures) -> str:
    """``text`` with a new table between every ``<!-- NAME -->`` of :data:`PARTS` and the next
    ``<!-- end -->``.
    """

    def replaced(match: re.Match[str]) -> str:
        return f"<!-- {match[1]} -->\n\n{PARTS[match[1]](figures)}\n\n<!-- end -->"

    return re.sub(
        rf"<!-- ({'|'.join(PARTS)}) -->\n.*?<!-- end -->", replaced, text, flags=re.DOTALL
    )


def table(head: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    return markdown(Table("", head, rows, names=len(head)))


def number(value: float) -> str:
    """Four decimals; two significant digits below 0.001; a bound where only rounding is left."""
    if 0.0 < abs(value) < 1e-10:
        return "< 1e-10"
    return f"{value:.1e}" if 0.0 < abs(value) < 1e-3 else f"{value:.4f}"


def traces_table(figures: Figures) -> str:
    """Largest differences of speed and distance per scene and peer."""
    head = [
        "scene",
        "peer",
        "quantity",
        "peer - ganlane",
        "law",
        "scheme",
        "allowed for the scheme",
        "rest",
    ]
    rows = []
    for row in figures["traces"]:
        distance = (
            ("position_m", "position, m") if row["scene"] == "free road" else ("gap_m", "gap, m")
        )
        for key, name in (("speed_mps", "speed, m/s"), distance):
            pieces = [
                number(row[piece][key]) for piece in ("direct", "law", "scheme", "allowed", "rest")
            ]
            rows.append([row["scene"], row["peer"], name, *pieces])
    return table(head, rows)


def settled_table(figures: Figures) -> str:
    """Equilibrium gaps per speed and simulator."""
    head = [
        "speed, m/s",
        "simulator",
        "mean gap, m",
        "formula of its law, m",
        "largest distance, m",
        "allowed, m",
    ]
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


def stops_table(figures: Figures) -> str:
    """Where the cars come to rest behind the obstacle."""
    rows = [
        [row["simulator"], f"{row['final_gap_m']:.4f}", f"{row['lowest_mps']:.4f}"]
        for row in figures["stops"]
    ]
    return table(["simulator", "final gap, m", "lowest speed, m/s"], rows)


def steps_table(figures: Figures) -> str:
    """What other steps do."""
    rows = [
        [row["other"], *(number(row[key]) for key in ("speed_mps", "gap_m"))]
        for row in figures["steps"]
    ]
    return table(["ganlane at 0.1 s against", "speed, m/s", "gap, m"], rows)


def versions_line(figures: Figures) -> str:
    """What the figures were taken with."""
    return ", ".join(f"{name} {version}" for name, version in figures["versions"].items())


PARTS: dict[str, Callable[[Figures], str]] = {
    "traces": traces_table,
    "settled": settled_table,
    "stops": stops_table,
    "steps": steps_table,
    "versions": versions_line,
}


MARKERS = dict(zip(("SUMO, Euler", "HighwayEnv", "SUMO, ballistic"), zip("osx", COLOURS)))
SCHEMES = {"HighwayEnv": Scheme.EXPLICIT_EULER, "SUMO, Euler": Scheme.SEMI_IMPLICIT_EULER}


@rc_context(STYLE)
def draw(traces: dict[str, dict[str, Trace]], figures: dict[str, Any], path: Path) -> None:
    """Four panels: speeds, what the schemes account for, equilibrium gaps, and the stop.

    Written to ``path``.
    """
    figure = Figure(figsize=(10, 7))
    (speeds, apart), (gaps, stop) = figure.subplots(2, 2)
    _speeds(speeds, traces[SLOW_AND_GO.name])
    _apart(apart, traces[SLOW_AND_GO.name])
    _gaps(gaps, figures["settled"])
    _stop(stop, traces[OBSTACLE.name])
    save_figure(figure, path)


def _times(trace: Trace) -> np.ndarray:
    return np.arange(len(trace.speed)) * PHYSICS_STEP_S


def _label(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set(title=title, xlabel=x, ylabel=y)
    axes.legend(fontsize=8)


def _speeds(axes: Axes, traces: dict[str, Trace]) -> None:
    mine = traces["ganlane"]
    for rank in (0, 1, 4, 8):
        axes.plot(
            _times(mine), mine.speed[:, rank], color=str(0.07 * rank), label=f"ganlane, car {rank}"
        )
    for start, (name, (marker, colour)) in enumerate(MARKERS.items()):
        every = slice(20 * start, None, 60)
        for rank in (1, 4, 8):
            label = name if rank == 1 else None
            at, speed = _times(mine)[every], traces[name].speed[every, rank]
            axes.plot(at, speed, marker, color=colour, ms=4, fillstyle="none", label=label)
    _label(axes, "slow and go: speeds of the leader (0) and its followers", "time, s", "speed, m/s")


def _apart(axes: Axes, traces: dict[str, Trace]) -> None:
    mine = traces["ganlane"]
    for name, scheme in SCHEMES.items():
        colour = MARKERS[name][1]
        expected = difference(mine, SLOW_AND_GO, scheme).speed[:, 8]
        axes.plot(
            _times(mine), traces[name].speed[:, 8] - mine.speed[:, 8], color=colour, label=name
        )
        axes.plot(
            _times(mine),
            expected,
            "--",
            color=INK,
            label=None if name == "HighwayEnv" else "derived",
        )
    left = traces["SUMO, ballistic"].speed[:, 8] - mine.speed[:, 8]
    axes.plot(_times(mine), left, color=MARKERS["SUMO, ballistic"][1], label="SUMO, ballistic")
    _label(axes, "slow and go, car 8: speed less ganlane's", "time, s", "difference, m/s")


def _gaps(axes: Axes, rows: list[dict[str, Any]]) -> None:
    speeds = np.linspace(0.0, 18.0, 100)
    axes.plot(speeds, [equilibrium_gap(v) for v in speeds], color=INK, label="$s_e(v)$")
    for name, (marker, colour) in {"ganlane": ("D", INK), **MARKERS}.items():
        mine = [(row["speed_mps"], row["gap_m"]) for row in rows if row["simulator"] == name]
        axes.plot(*zip(*mine), marker, color=colour, fillstyle="none", label=name)
    _label(axes, "equilibrium gaps", "speed, m/s", "gap, m")


def _stop(axes: Axes, traces: dict[str, Trace]) -> None:
    for name, colour in {
        "ganlane": INK,
        **{name: colour for name, (_, colour) in MARKERS.items()},
    }.items():
        style = "--" if name == "SUMO, ballistic" else "-"
        axes.plot(_times(traces[name]), traces[name].gap[:, 0], style, color=colour, label=name)
    axes.axhline(TABLE_V.min_gap_m, color="grey", lw=0.8)
    axes.set(xlim=(20.0, 45.0), ylim=(1.5, 6.0))
    _label(axes, "standing obstacle: the last metres", "time, s", "gap, m")
