"""Shows a card: tables on stdout, a section of a document, figures, and the file that ships."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ganlane.config.folders import stored_command
from ganlane.config.recordings import RealismConfig
from ganlane.errors import UserError
from ganlane.evaluation import code_version, machine
from ganlane.evaluation.table import aligned, number, with_interval
from ganlane.evaluation.table import show as show_tables
from ganlane.files import split_at_markers, write_between_markers, write_bytes
from ganlane.realism import measures
from ganlane.realism.card import Card, floors_of
from ganlane.realism.driving import FLOORS
from ganlane.realism.measures import QUANTITIES, UNITS
from ganlane.realism.starts import Starts, print_progress
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

#: Colour of the recordings.
RECORDED = INK


def check_targets(config: RealismConfig, path: Path | None) -> None:
    """Raise :class:`UserError`, before anything is driven, if the results could not be written."""
    if config.publish and path is None:
        raise UserError("publish=true: the file that ships is made from recordings; give data.path=FILE.")
    if config.report is not None:
        split_at_markers(Path(config.report), *markers(config.card()))
    if config.figures is not None and not Path(config.figures).is_dir():
        raise UserError(f"figures={config.figures}: no such folder; make it, or name another.")


def show(
    config: RealismConfig, folder: Path, tables: list[str], numbers: Mapping[str, Any], drawn: Sequence[Path]
) -> None:
    """Print the tables; write tables and figures into a document if asked for."""
    show_tables(*tables, columns=config.columns)
    if config.report is not None:
        command = stored_command(folder, "python -m ganlane.realism", without=("report=", "figures=", "hydra."))
        text = document_text(tables, numbers, command, date.today().isoformat())
        write_between_markers(Path(config.report), *markers(config.card()), f"\n{text}\n")
    for path in drawn if config.figures is not None else []:
        write_bytes(Path(str(config.figures)) / f"realism_{path.name}", path.read_bytes())


def publish(starts: Starts) -> None:
    """Write the file that ships, with the distances of the reference drivers measured in this run."""
    source = Path(starts.reference.source).name
    floors = floors_of(starts.driven, starts.recorded.counts)
    replace(starts.reference, floors=floors, source=source).save(measures.SHIPPED_REFERENCE)
    print_progress(f"wrote {measures.SHIPPED_REFERENCE}")


def markers(card: str) -> tuple[str, str]:
    """The lines that enclose a card in a document; its name holds traffic and starts."""
    return f"<!-- begin realism {card} -->", f"<!-- end realism {card} -->"


def card_text(numbers: Mapping[str, Any], long_runs: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[str]:
    """The card's tables: of the ``numbers`` in ``results.json``, and of the long runs of all traffics."""
    traffic = numbers["traffic"]
    tables = [quantities_table(numbers["quantities"], traffic)]
    if numbers["quantities_held_out"] is not None:
        tables.append(f"held-out scenes alone\n{quantities_table(numbers['quantities_held_out'], traffic)}")
    tables.append(starts_table(numbers["driving"]))
    tables += [f"I-80, {name}\n{quantities_table(rows, traffic)}" for name, rows in numbers["i80"].items()]
    tables += [long_table(runs, name) for name, runs in long_runs.items() if runs]
    return [*tables, checks_text(numbers["checks"])]


def document_text(tables: Sequence[str], numbers: Mapping[str, Any], command: str, written: str) -> str:
    """A card's section of a document: command, machine, starts, tables."""
    here, code = machine(), code_version()
    revision = f" ({code['revision'][:12]}{', modified' if code['modified'] else ''})" if code["revision"] else ""
    excess = ", ".join(f"{name} {value:g}" for name, value in numbers["desired_above_mps"].items())
    paragraphs = [
        f"Written by the command on {written}:\n\n    {command}",
        f"Taken with Python {here['python']}, torch {here['torch']}, ganlane {code['version']}{revision}, from "
        f"{numbers['starts']} starts: {', '.join(numbers['scenes']) or 'none recorded'}. Desired speeds above the "
        f"speed at entry, mean, m/s: {excess or 'not fitted'}.",
    ]
    return "\n\n".join([*paragraphs, *(f"```text\n{table}\n```" for table in tables)])


def quantities_table(quantities: Mapping[str, Any], traffic: str) -> str:
    """Distances, one quantity per line: the traffic, the scale, and each rival with the difference to it."""
    others = list(next(iter(quantities.values()))["against"])
    heading = ["distance to recorded", f"{short_name(traffic)} [95 %]", "ceiling", "constant v", "random"]
    for other in others:
        heading += [short_name(other), f"minus {short_name(other)} [95 %]", ""]
    lines = [heading]
    for name, row in quantities.items():
        scale = (number(row[key]) for key in ("ceiling", "constant_velocity", "floor"))
        line = [f"{name}, {row['unit']}", with_interval(row, "distance"), *scale]
        for other in others:
            rival = row["against"][other]
            line += [number(rival["distance"]), with_interval(rival, "difference"), rival["verdict"]]
        lines.append(line)
    return aligned(lines)


def starts_table(driving: Mapping[str, Any]) -> str:
    """Lane changes and accelerations, one traffic per line, the recordings among them."""
    lines = [["from the same starts", "changes per vehicle-km [95 %]", "vehicle-km", "acceleration 5 %, 95 %"]]
    for name, row in driving.items():
        low, high = (row["quantiles"]["acceleration"][level] for level in ("0.05", "0.95"))
        rate, km = with_interval(row, "per_vehicle_km", 2), number(row["vehicle_km"], 1)
        lines.append([short_name(name), rate, km, f"{number(low, 2)}, {number(high, 2)}"])
    return aligned(lines)


def long_table(runs: Sequence[Mapping[str, Any]], traffic: str) -> str:
    """The long runs of a traffic, one column each."""
    cells = {
        f"{short_name(traffic)}, long runs": [f"{run['vehicles']} vehicles" for run in runs],
        "vehicle-km": [number(run["vehicle_km"], 0) for run in runs],
        "changes per vehicle-km": [with_interval(run, "lane_changes_per_vehicle_km", 2) for run in runs],
        "overlaps per 1000 vehicle-km": [with_interval(run, "overlaps_per_1000_vehicle_km", 2) for run in runs],
        "off road": [str(run["off_road"]) for run in runs],
        "standstills in free flow": [str(run["standstills_in_free_flow"]) for run in runs],
    }
    for time in runs[0]["speeds"]:
        at = [run["speeds"][time] for run in runs]
        cells[f"mean speed, spread after {time}, m/s"] = [
            f"{number(each['mean_speed_mps'], 1)}, {number(each['spread_mps'], 2)}" for each in at
        ]
    for level in runs[0]["acceleration_quantiles"]:
        quantiles = [number(run["acceleration_quantiles"][level], 2) for run in runs]
        cells[f"acceleration, {100 * float(level):g} % quantile"] = quantiles
    shares = [run["guard_share"] for run in runs]
    cells["the guard's share"] = ["none" if share is None else f"{100 * share:.1f} %" for share in shares]
    return aligned([[name, *row] for name, row in cells.items()])


def checks_text(checks: Mapping[str, Any]) -> str:
    """The card's checks, a line each."""

    def told(name: str, value: bool | None) -> str:
        unknown = "no guard" if name == "guard_under_5_percent" else "unknown"
        return f"{name.replace('_', ' ')}: {unknown if value is None else 'yes' if value else 'no'}"

    near = "acceleration_quantiles_within_30_percent"
    lines = [told(near, checks[near])]
    for other, verdicts in checks["compared_with"].items():
        lines.append(f"than {short_name(other)}: " + ", ".join(map(" ".join, verdicts.items())))
    for run in checks["long_runs"]:
        results = ", ".join(told(name, value) for name, value in run.items() if name != "vehicles")
        lines.append(f"{run['vehicles']} vehicles: {results}")
    return "\n".join(lines)


def short_name(traffic: str) -> str:
    """A traffic's name without the path that it is imported from."""
    return traffic.rpartition(".")[2]


@rc_context(STYLE)
def draw_distributions(
    recorded: Mapping[str, FloatArray], simulated: Mapping[str, Mapping[str, FloatArray]]
) -> Figure:
    """One panel per quantity: the recorded density, and each traffic's; none where nothing was counted.

    Both are counts [bins], by quantity; ``simulated`` by traffic first.
    """
    figure, grid = panel_grid(len(recorded))
    colours = {**palette(list(simulated)), "recorded": RECORDED}
    for axes, name in zip(grid, recorded):
        bounds, unit = QUANTITIES[name].edges, UNITS[name].replace("s2", "s²").replace("s3", "s³")
        axes.set(title=name.replace("_", " "), xlabel=unit, ylabel=f"density, per {unit}")
        axes.set_xlim(bounds[0], bounds[-1])
        for driver, counts in {**simulated, "recorded": recorded}.items():
            if total := float(counts[name].sum()):
                middle = 0.5 * (bounds[1:] + bounds[:-1])
                density = counts[name] / total / np.diff(bounds)
                plot_line(axes, middle, density, color=colours[driver])
                # The bins at both ends hold all values beyond, too.
                for end, mark in ((0, "<"), (-1, ">")):
                    if counts[name][end]:
                        axes.plot(middle[end], density[end], mark, color=colours[driver], clip_on=False)
    beyond = Line2D([], [], color=FAINT, label="and all values beyond", marker=">", ls="")
    add_legend(figure, {"recorded": RECORDED, **colours}, [beyond])
    return figure


@rc_context(STYLE)
def draw_distances(quantities: Mapping[str, Any], traffic: str) -> Figure:
    """The rows of :func:`ganlane.realism.card.quantity_rows`: a block per quantity, a line per traffic.

    Vertical lines are the ends of the scale: recordings against each other, and random driving.
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
    add_legend(figure, {short_name(name): colour for name, colour in colours.items()}, marks)
    return figure


@rc_context(STYLE)
def draw_speeds_over_time(runs: Sequence[Mapping[str, Any]], spread_mps: float) -> Figure:
    """Mean and spread of the speeds of long runs over time; the recorded mean spread within a frame as a level."""
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


def draw(card: Card, to: Path) -> list[Path]:
    """The figures of a card, into the folder ``to``: distributions, distances, and drift if there are long runs."""
    starts = card.starts
    simulated = {
        short_name(name): {quantity: counts.sum(0) for quantity, counts in driven.counts.items()}
        for name, driven in starts.driven.items()
        if name not in FLOORS
    }
    recorded = {name: counts.sum(0) for name, counts in starts.recorded.counts.items()}
    figures = {
        "distributions": draw_distributions(recorded, simulated),
        "distances": draw_distances(card.quantities, card.traffic),
    }
    if runs := card.long_runs[card.traffic]:
        figures["drift"] = draw_speeds_over_time(runs, starts.reference.spread_mps)
    return [save_figure(figure, to / f"{name}.png") for name, figure in figures.items()]
