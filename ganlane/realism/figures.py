"""Figures of the realism card: distributions, distances, and the speeds of long runs over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ganlane.realism.fit_speeds import FLOORS
from ganlane.realism.quantities import QUANTITIES, UNITS
from ganlane.realism.starts import Starts
from ganlane.view.figures import FAINT, GRID, INK, STYLE, FloatArray, add_legend, palette, panel_grid, plot_line

RECORDED = INK


@rc_context(STYLE)
def draw_distributions(
    edges: Mapping[str, FloatArray],
    recorded: Mapping[str, FloatArray],
    simulated: Mapping[str, Mapping[str, FloatArray]],
    units: Mapping[str, str],
) -> Figure:
    """One panel per quantity: the recorded density, and each traffic's; none where nothing was counted.

    Args:
        edges: by quantity, of its bins [B + 1].
        recorded: by quantity, counts [B].
        simulated: by traffic, then quantity.
        units: by quantity.
    """
    figure, grid = panel_grid(len(edges))
    colours = {**palette(list(simulated)), "recorded": RECORDED}
    for axes, (name, bounds) in zip(grid, edges.items()):
        unit = _pretty(units[name])
        axes.set(title=name.replace("_", " "), xlabel=unit, ylabel=f"density, per {unit}")
        axes.set_xlim(bounds[0], bounds[-1])
        for driver, counts in {**simulated, "recorded": recorded}.items():
            if total := float(counts[name].sum()):
                middle = 0.5 * (bounds[1:] + bounds[:-1])
                plot_line(axes, middle, counts[name] / total / np.diff(bounds), color=colours[driver])
    add_legend(figure, {"recorded": RECORDED, **colours})
    return figure


@rc_context(STYLE)
def draw_distances(quantities: Mapping[str, Any], traffic: str) -> Figure:
    """Distances to recorded driving: a block of rows per quantity with each traffic's value and interval.

    Upright lines are the ends of the scale: recordings against each other, and random driving.

    Args:
        quantities: rows of :func:`ganlane.realism.card.quantity_rows`.
        traffic: the card's own.
    """
    others = list(next(iter(quantities.values()))["against"])
    colours = palette([traffic, *others])
    block = len(colours) + 1
    figure = Figure(figsize=(7.5, 0.8 + 0.125 * block * len(quantities)))
    axes = figure.subplots()
    axes.set(xlim=(0, 1), ylim=(block * len(quantities), 0), xlabel="Jensen-Shannon distance to recorded driving")
    axes.set_yticks([block * (index + 0.5) for index in range(len(quantities))])
    axes.set_yticklabels([name.replace("_", " ") for name in quantities], color=INK, size=9)
    axes.tick_params("y", length=0)
    axes.grid(False, axis="y")
    for index, row in enumerate(quantities.values()):
        top = block * index
        axes.axhline(top, color=GRID, lw=0.8)
        for mark, colour in (("ceiling", INK), ("floor", FAINT)):
            if row[mark] is not None:
                axes.vlines(row[mark], top + 0.3, top + block - 0.3, color=colour, lw=1.6)
        for line, (driver, colour) in enumerate(colours.items()):
            shown = row if driver == traffic else row["against"][driver]
            if shown["distance"] is not None:
                low, high = shown["distance_ci"] or (shown["distance"], shown["distance"])
                axes.plot([low, high], [top + line + 1] * 2, color=colour)
                axes.plot(shown["distance"], top + line + 1, "o", color=colour, ms=5)
    ends = {"half against half": INK, "random": FAINT}
    marks = [Line2D([], [], color=colour, label=name, marker="|", ls="", ms=10) for name, colour in ends.items()]
    add_legend(figure, {name.rpartition(".")[2]: colour for name, colour in colours.items()}, marks)
    return figure


@rc_context(STYLE)
def draw_drift(runs: Sequence[Mapping[str, Any]], spread_mps: float) -> Figure:
    """Mean and spread of the speeds of long runs over time; the recorded spread as a level.

    Args:
        runs: as :func:`ganlane.realism.long_runs.summary` gives them.
        spread_mps: the recorded mean spread within a frame.
    """
    figure, grid = panel_grid(2)
    colours = palette([f"{run['vehicles']} vehicles" for run in runs])
    for axes, (key, title) in zip(grid, {"mean_speed_mps": "mean speed", "spread_mps": "spread of speeds"}.items()):
        axes.set(title=title, xlabel="time, s", ylabel="m/s")
        for run, colour in zip(runs, colours.values()):
            timed = [(float(time.split()[0]), at[key]) for time, at in run["speeds"].items() if time.endswith(" s")]
            x, y = np.array(timed, dtype=np.float64).T  # None, where nobody was left to measure, becomes NaN
            plot_line(axes, x, y, color=colour)
    grid[1].axhline(spread_mps, color=RECORDED)
    add_legend(figure, {"recorded": RECORDED, **colours})
    return figure


def card_figures(
    starts: Starts, runs: Sequence[Mapping[str, Any]], quantities: Mapping[str, Any], traffic: str
) -> dict[str, Figure]:
    """The figures of a card by name: ``distributions``, ``distances``, and ``drift`` if there are long runs.

    Args:
        starts: every traffic from the same starts.
        runs: the traffic's long runs.
        quantities: its rows.
        traffic: its name.
    """
    simulated = {
        name.rpartition(".")[2]: {quantity: counts.sum(0) for quantity, counts in driven.counts.items()}
        for name, driven in starts.driven.items()
        if name not in FLOORS
    }
    edges = {name: bins.edges for name, bins in QUANTITIES.items()}
    recorded = {name: counts.sum(0) for name, counts in starts.recorded.items()}
    figures = {
        "distributions": draw_distributions(edges, recorded, simulated, UNITS),
        "distances": draw_distances(quantities, traffic),
    }
    return figures | ({"drift": draw_drift(runs, starts.reference.spread_mps)} if runs else {})


def _pretty(unit: str) -> str:
    """A unit with its exponent raised: m/s² for m/s2."""
    return unit.replace("s2", "s²").replace("s3", "s³")
