"""The comparison as a figure of four panels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.peers.scene import OBSTACLE, SLOW_AND_GO, Trace
from benchmarks.peers.schemes import Scheme, equilibrium_gap
from benchmarks.peers.tolerance import difference
from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.idm import TABLE_V
from ganlane.view.figures import COLOURS, INK, STYLE, save_figure

MARKERS = dict(zip(("SUMO, Euler", "HighwayEnv", "SUMO, ballistic"), zip("osx", COLOURS)))
SCHEMES = {"HighwayEnv": Scheme.EXPLICIT_EULER, "SUMO, Euler": Scheme.SEMI_IMPLICIT_EULER}


@rc_context(STYLE)
def draw(traces: dict[str, dict[str, Trace]], figures: dict[str, Any], path: Path) -> None:
    """Four panels: speeds, what the schemes account for, equilibrium gaps, and the stop; written to ``path``."""
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
        axes.plot(_times(mine), mine.speed[:, rank], color=str(0.07 * rank), label=f"ganlane, car {rank}")
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
        axes.plot(_times(mine), traces[name].speed[:, 8] - mine.speed[:, 8], color=colour, label=name)
        axes.plot(_times(mine), expected, "--", color=INK, label=None if name == "HighwayEnv" else "derived")
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
    for name, colour in {"ganlane": INK, **{name: colour for name, (_, colour) in MARKERS.items()}}.items():
        style = "--" if name == "SUMO, ballistic" else "-"
        axes.plot(_times(traces[name]), traces[name].gap[:, 0], style, color=colour, label=name)
    axes.axhline(TABLE_V.min_gap_m, color="grey", lw=0.8)
    axes.set(xlim=(20.0, 45.0), ylim=(1.5, 6.0))
    _label(axes, "standing obstacle: the last metres", "time, s", "gap, m")
