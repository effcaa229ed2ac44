"""The figures of the comparison as the tables of docs/peers.md and as a plot of four panels."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.peers.scene import OBSTACLE, SLOW_AND_GO, Scheme, Trace, equilibrium_gap
from benchmarks.peers.tolerance import difference
from benchmarks.script import markdown
from ganlane.evaluation.table import Cell, Table, number_of, text_of
from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.idm import TABLE_V
from ganlane.view.figures import COLOURS, INK, STYLE, save_figure

Figures = dict[str, Any]


def number(value: float) -> str:
    """Four decimals; two significant digits below 0.001; a bound where only rounding is left."""
    if 0.0 < abs(value) < 1e-10:
        return "< 1e-10"
    return f"{value:.1e}" if 0.0 < abs(value) < 1e-3 else f"{value:.4f}"


def traces_table(figures: Figures) -> str:
    """Largest differences of speed and distance per scene and peer."""
    heads = {
        "direct": "peer - ganlane",
        "law": "law",
        "scheme": "scheme",
        "allowed": "allowed for the scheme",
        "rest": "rest",
    }
    lines = []
    for row in figures["traces"]:
        distance = "position" if row["scene"] == "free road" else "gap"
        for key, name in (("speed_mps", "speed, m/s"), (f"{distance}_m", f"{distance}, m")):
            pieces = [number(row[piece][key]) for piece in heads]
            lines.append([row["scene"], row["peer"], name, *pieces])
    headings = ["scene", "peer", "quantity", *heads.values()]
    return markdown(Table("", headings, lines, names=len(headings)))


#: Heading to cell of the columns: equilibrium gaps per speed and simulator.
SETTLED: dict[str, Cell] = {
    "speed, m/s": lambda row: f"{row['speed_mps']:g}",
    "simulator": text_of("simulator"),
    "mean gap, m": number_of("gap_m", 6),
    "formula of its law, m": number_of("formula_m", 6),
    "largest distance, m": lambda row: f"{row['away_m']:.1e}",
    "allowed, m": lambda row: f"{row['allowed_m']:.1e}",
}
#: Where the cars come to rest behind the obstacle.
STOPS: dict[str, Cell] = {
    "simulator": text_of("simulator"),
    "final gap, m": number_of("final_gap_m", 4),
    "lowest speed, m/s": number_of("lowest_mps", 4),
}
#: What other steps do.
STEPS: dict[str, Cell] = {
    "ganlane at 0.1 s against": text_of("other"),
    "speed, m/s": lambda row: number(row["speed_mps"]),
    "gap, m": lambda row: number(row["gap_m"]),
}


def table_of(name: str, columns: Mapping[str, Cell]) -> Callable[[Figures], str]:
    """Makes the Markdown table of the rows ``name``."""
    return lambda figures: markdown(Table.of("", figures[name], columns, len(columns)))


def versions_line(figures: Figures) -> str:
    """What the figures were taken with."""
    return ", ".join(f"{name} {version}" for name, version in figures["versions"].items())


#: Of the page, by name.
PARTS: dict[str, Callable[[Figures], str]] = {
    "traces": traces_table,
    "settled": table_of("settled", SETTLED),
    "stops": table_of("stops", STOPS),
    "steps": table_of("steps", STEPS),
    "versions": versions_line,
}


MARKERS = dict(zip(("SUMO, Euler", "HighwayEnv", "SUMO, ballistic"), zip("osx", COLOURS)))
WITH_OURS = {"ganlane": ("D", INK), **MARKERS}
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


def _plot(axes: Axes, values: np.ndarray, *form: str, **style: Any) -> None:
    """Values of consecutive physics steps over time."""
    axes.plot(np.arange(len(values)) * PHYSICS_STEP_S, values, *form, **style)


def _label(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set(title=title, xlabel=x, ylabel=y)
    axes.legend(fontsize=8)


def _speeds(axes: Axes, traces: dict[str, Trace]) -> None:
    for rank in (0, 1, 4, 8):
        shade = str(0.07 * rank)
        _plot(axes, traces["ganlane"].speed[:, rank], color=shade, label=f"ganlane, car {rank}")
    for start, (name, (marker, colour)) in enumerate(MARKERS.items()):
        style: dict[str, Any] = {"color": colour, "ms": 4, "fillstyle": "none"}
        for rank in (1, 4, 8):
            speed = traces[name].speed[:, rank]
            label = name if rank == 1 else None
            _plot(axes, speed, marker, markevery=(20 * start, 60), label=label, **style)
    _label(axes, "slow and go: speeds of the leader (0) and its followers", "time, s", "speed, m/s")


def _apart(axes: Axes, traces: dict[str, Trace]) -> None:
    mine = traces["ganlane"]
    for name in ("HighwayEnv", "SUMO, Euler", "SUMO, ballistic"):
        _plot(axes, (traces[name].speed - mine.speed)[:, 8], color=MARKERS[name][1], label=name)
        if name in SCHEMES:
            derived = difference(mine, SLOW_AND_GO, SCHEMES[name]).speed[:, 8]
            label = None if name == "HighwayEnv" else "derived"
            _plot(axes, derived, "--", color=INK, label=label)
    _label(axes, "slow and go, car 8: speed less ganlane's", "time, s", "difference, m/s")


def _gaps(axes: Axes, rows: list[dict[str, Any]]) -> None:
    speeds = np.linspace(0.0, 18.0, 100)
    axes.plot(speeds, [equilibrium_gap(v) for v in speeds], color=INK, label="$s_e(v)$")
    for name, (marker, colour) in WITH_OURS.items():
        mine = [(row["speed_mps"], row["gap_m"]) for row in rows if row["simulator"] == name]
        axes.plot(*zip(*mine), marker, color=colour, fillstyle="none", label=name)
    _label(axes, "equilibrium gaps", "speed, m/s", "gap, m")


def _stop(axes: Axes, traces: dict[str, Trace]) -> None:
    for name, (_, colour) in WITH_OURS.items():
        style = "--" if name == "SUMO, ballistic" else "-"
        _plot(axes, traces[name].gap[:, 0], style, color=colour, label=name)
    axes.axhline(TABLE_V.min_gap_m, color="grey", lw=0.8)
    axes.set(xlim=(20.0, 45.0), ylim=(1.5, 6.0))
    _label(axes, "standing obstacle: the last metres", "time, s", "gap, m")
