"""A card as tables and figures, from the numbers in its ``results.json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ganlane.evaluation.table import aligned, number, with_interval
from ganlane.realism.driving import FLOORS
from ganlane.realism.measures import QUANTITIES, Measured
from ganlane.realism.starts import Starts
from ganlane.view.figures import (
    FAINT,
    GRID,
    INK,
    STYLE,
    FloatArray,
    add_legend,
    palette,
    panel_grid,
    plot_line,
    save_figure,
)


def card_text(numbers: Mapping[str, Any]) -> list[str]:
    """The card's tables, each as text.

    ``numbers`` are those of :func:`ganlane.realism.card.card_numbers`, or what ``results.json``
    holds of them: the tables can be made again from the file.
    """
    traffic = numbers["traffic"]

    # All scenes first; what was held out from the fit apart, where both were driven.
    tables = [quantities_table(numbers["quantities"], traffic)]
    held_out = numbers["quantities_held_out"]
    if held_out is not None:
        tables.append(f"held-out scenes alone\n{quantities_table(held_out, traffic)}")
    tables.append(starts_table(numbers["driving"]))

    # A second site, to which nothing was fitted.
    for name, rows in numbers["i80"].items():
        tables.append(f"{name}\n{quantities_table(rows, traffic)}")

    # The traffic first, then its rivals.
    long_runs = {traffic: numbers["long_runs"], **numbers["long_runs_against"]}
    for name, runs in long_runs.items():
        if runs:
            tables.append(long_table(runs, name))
    return tables


def quantities_table(quantities: Mapping[str, Any], traffic: str) -> str:
    """Jensen-Shannon distances to recorded driving, from 0 to 1, one quantity per line.

    The traffic, the scale, and each rival with the difference to it.

    Args:
        quantities: rows of :func:`ganlane.realism.card.card_rows` by quantity.
        traffic: name of the traffic that the card is about.
    """
    # All rows have the same rivals.
    first_row = next(iter(quantities.values()))
    rivals = list(first_row["against"])

    heading = [
        "distance to recorded",
        f"{short_name(traffic)} [95 %]",
        "ceiling",
        "constant v",
        "random",
    ]
    for rival in map(short_name, rivals):
        # The verdict's column needs no heading.
        heading += [rival, f"minus {rival} [95 %]", ""]

    lines = [heading]
    for name, row in quantities.items():
        line = [f"{name}, {row['unit']}", with_interval(row, "distance")]

        # The scale: from the best that can be expected to random driving.
        for end in ("ceiling", "constant_velocity", "floor"):
            line.append(number(row[end]))

        for rival in rivals:
            # The difference is paired: both drove the same scenes.
            theirs = row["against"][rival]
            line += [
                number(theirs["distance"]),
                with_interval(theirs, "difference"),
                theirs["verdict"],
            ]

        lines.append(line)
    return aligned(lines)


def starts_table(driving: Mapping[str, Any]) -> str:
    """Lane changes and accelerations, one traffic per line, the recordings among them.

    ``driving`` holds by name what :meth:`ganlane.realism.measures.Measured.summary` returns.
    """
    heading = [
        "from the same starts",
        "changes per vehicle-km [95 %]",
        "vehicle-km",
        "acceleration 5 %, 95 %",
    ]
    lines = [heading]
    for name, row in driving.items():
        acceleration = row["quantiles"]["acceleration"]
        low = number(acceleration["0.05"], 2)
        high = number(acceleration["0.95"], 2)
        lines.append(
            [
                short_name(name),
                with_interval(row, "per_vehicle_km", 2),
                number(row["vehicle_km"], 1),
                f"{low}, {high}",
            ]
        )
    return aligned(lines)


def long_table(runs: Sequence[Mapping[str, Any]], traffic: str) -> str:
    """The long runs of a traffic, one column each.

    ``runs`` are those of :func:`ganlane.realism.long_runs.long_run`; at least one.
    """
    columns = [_run_cells(run, traffic) for run in runs]

    lines = []
    # All runs have the same lines.
    for name in columns[0]:
        lines.append([name, *(column[name] for column in columns)])
    return aligned(lines)


def _run_cells(run: Mapping[str, Any], traffic: str) -> dict[str, str]:
    """A column of :func:`long_table`, by the names of its lines.

    Rates have their 95 % intervals; ``-`` stands where no vehicle moved or none came so far.
    """
    cells = {
        f"{short_name(traffic)}, long runs": f"{run['vehicles']} vehicles",
        "vehicle-km": number(run["vehicle_km"], 0),
        "changes per vehicle-km": with_interval(run, "lane_changes_per_vehicle_km", 2),
        "overlaps per 1000 vehicle-km": with_interval(run, "overlaps_per_1000_vehicle_km", 2),
        "off road": str(run["off_road"]),
        "standstills in free flow": str(run["standstills_in_free_flow"]),
    }

    for time, at in run["speeds"].items():
        mean = number(at["mean_speed_mps"], 1)
        spread = number(at["spread_mps"], 2)
        cells[f"mean speed, spread after {time}, m/s"] = f"{mean}, {spread}"

    # The tails show most: recorded drivers brake and accelerate harder than models.
    for level, value in run["acceleration_quantiles"].items():
        cells[f"acceleration, {100 * float(level):g} % quantile"] = number(value, 2)
    return cells


def short_name(traffic: str) -> str:
    """A traffic's name without the path that it is imported from.

    ``MyTraffic`` of ``my.module.MyTraffic``; an option's name as it is.
    """
    return traffic.rpartition(".")[2]


def draw(numbers: Mapping[str, Any], starts: Starts, to: Path) -> None:
    """The figures of a card, distributions and distances, into the folder ``to``.

    Args:
        numbers: of :func:`ganlane.realism.card.card_numbers`.
        starts: what was driven; only it holds the histograms.
        to: an existing folder, where ``distributions.png`` and ``distances.png`` go.
    """
    totals = {}
    for name, measured in starts.driven.items():
        # The reference drivers would hide the others.
        if name not in FLOORS:
            totals[short_name(name)] = _pooled(measured)

    distributions = draw_distributions(_pooled(starts.recorded), totals)
    save_figure(distributions, to / "distributions.png")

    distances = draw_distances(numbers["quantities"], numbers["traffic"])
    save_figure(distances, to / "distances.png")


def _pooled(measured: Measured) -> dict[str, FloatArray]:
    """By quantity, the counts [bins] over all units: a figure has one line per traffic."""
    return {name: counts.sum(0) for name, counts in measured.counts.items()}


@rc_context(STYLE)
def draw_distributions(
    recorded: Mapping[str, FloatArray],
    simulated: Mapping[str, Mapping[str, FloatArray]],
) -> Figure:
    """A panel per quantity: the recorded density and each traffic's, none where it has no samples.

    All have the bins of :data:`ganlane.realism.measures.QUANTITIES`.

    Args:
        recorded: counts [bins] by quantity.
        simulated: the same by traffic.
    """
    figure, grid = panel_grid(len(recorded))

    # The recordings are black everywhere, and come last, on top.
    colours = {"recorded": INK, **palette(list(simulated))}
    drivers = {**simulated, "recorded": recorded}

    for axes, name in zip(grid, recorded):
        quantity = QUANTITIES[name]
        edges = quantity.edges
        unit = quantity.unit.replace("s2", "s²").replace("s3", "s³")
        axes.set(
            title=name.replace("_", " "),
            xlabel=unit,
            ylabel=f"density, per {unit}",
        )
        axes.set_xlim(edges[0], edges[-1])

        for driver, by_quantity in drivers.items():
            _draw_density(axes, edges, by_quantity[name], colours[driver])

    # A legend for the marks at both ends of the densities.
    beyond = Line2D([], [], color=FAINT, label="and all values beyond", marker=">", ls="")
    add_legend(figure, colours, [beyond])
    return figure


def _draw_density(axes: Axes, edges: FloatArray, counts: FloatArray, colour: str) -> None:
    """A line of the density in bins with these ``edges`` [bins + 1], from ``counts`` [bins]."""
    total = float(counts.sum())
    if not total:
        return

    # Densities, so that traffics with more samples are not higher.
    density = counts / total / np.diff(edges)
    middle = 0.5 * (edges[1:] + edges[:-1])
    plot_line(axes, middle, density, color=colour)

    # The bins at both ends hold all values beyond, too.
    for end, mark in ((0, "<"), (-1, ">")):
        if counts[end]:
            axes.plot(middle[end], density[end], mark, clip_on=False, color=colour)


@rc_context(STYLE)
def draw_distances(quantities: Mapping[str, Any], traffic: str) -> Figure:
    """A block per quantity with a line per traffic: distances with their intervals.

    Vertical lines are the ends of the scale: recordings against each other, and random driving.

    Args:
        quantities: rows of :func:`ganlane.realism.card.card_rows` by quantity; at least one.
        traffic: name of the traffic that the card is about.
    """
    # All rows have the same rivals.
    first_row = next(iter(quantities.values()))
    colours = palette([traffic, *first_row["against"]])

    # Label and colour of the best that can be expected, and the worst that makes sense.
    scale = {
        "ceiling": ("half against half", INK),
        "floor": ("random", FAINT),
    }

    # A line per traffic, and an empty one; from top to bottom.
    block = len(colours) + 1
    lines = block * len(quantities)
    figure = Figure(figsize=(7.5, 0.8 + 0.125 * lines))
    axes = figure.subplots()
    # Distances go from 0 to 1, and the first line is on top.
    axes.set(xlim=(0, 1), ylim=(lines, 0))
    axes.set_xlabel("Jensen-Shannon distance to recorded driving")

    # A name beside the middle of its block.
    names = [name.replace("_", " ") for name in quantities]
    middles = block * (np.arange(len(names)) + 0.5)
    axes.set_yticks(middles, names, color=INK, size=9)
    axes.tick_params("y", length=0)
    axes.grid(False, axis="y")

    for index, row in enumerate(quantities.values()):
        # A line between two blocks, and the scale across this one.
        top = block * index
        axes.axhline(top, color=GRID, lw=0.8)
        for mark, (_, colour) in scale.items():
            if row[mark] is not None:
                axes.vlines(row[mark], top + 0.3, top + block - 0.3, color=colour, lw=1.6)

        # Traffics in the order of the legend.
        for y, (driver, colour) in enumerate(colours.items(), top + 1):
            shown = row if driver == traffic else row["against"][driver]

            # A quantity without samples has no mark.
            value = shown["distance"]
            if value is not None:
                # A single scene has no interval.
                ends = shown["distance_ci"] or [value, value]
                axes.plot(ends, [y, y], color=colour)
                axes.plot(value, y, "o", color=colour, ms=5)

    # Marks of the scale, which no traffic has.
    marks = [
        Line2D([], [], color=colour, label=name, marker="|", ls="", ms=10)
        for name, colour in scale.values()
    ]
    by_traffic = {short_name(name): colour for name, colour in colours.items()}
    add_legend(figure, by_traffic, marks)
    return figure
