"""A card: a traffic's distances to the recordings, and checks; as tables and figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ganlane.evaluation import code_version, machine
from ganlane.evaluation.statistics import Array, Estimate, entries
from ganlane.evaluation.table import aligned, number, percent, with_interval
from ganlane.realism.driving import FLOORS
from ganlane.realism.long_runs import totals
from ganlane.realism.measures import (
    QUANTITIES,
    RESAMPLES,
    UNITS,
    Measured,
    ceiling,
    distance,
    distance_difference,
    pooled_distance,
)
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

#: Quantities in which generated traffic should come closer to recordings than rules do.
CLOSER_IN = (
    "speed_spread",
    "acceleration",
    "time_headway",
    "time_to_collision",
    "lane_change_duration",
)


@dataclass(frozen=True)
class Card:
    """A traffic's card: the driving, and the numbers computed from it.

    Attributes:
        traffic: its name.
        starts: every traffic from the same starts.
        site: rows of a site that no generator was fitted to, by file; empty without it.
        long_runs: by traffic, this one's first; each with a run per number of vehicles.
        resamples: of the bootstrap.
    """

    traffic: str
    starts: Starts
    site: Mapping[str, Any]
    long_runs: Mapping[str, list[dict[str, Any]]]
    resamples: int

    @cached_property
    def quantities(self) -> dict[str, Any]:
        """Its rows, by quantity."""
        return card_rows(self.starts, self.traffic, self.resamples)

    def numbers(self) -> dict[str, Any]:
        """The content of ``results.json``."""
        starts, held_out = self.starts, self.starts.separately_held_out
        apart = (
            card_rows(starts.restricted_to(held_out), self.traffic, self.resamples)
            if held_out
            else None
        )
        driving = {
            name: each.summary()
            for name, each in {"recorded": starts.recorded, **starts.driven}.items()
        }
        own, recorded = (driving[name]["quantiles"] for name in (self.traffic, "recorded"))
        runs, rate, spread = (
            self.long_runs[self.traffic],
            starts.reference.rate(),
            starts.reference.spread_mps,
        )
        checks = card_checks(
            self.quantities, own, recorded, rate["per_vehicle_km_ci"], spread, runs
        )
        return {
            "traffic": self.traffic,
            **starts.description(),
            "quantities": self.quantities,
            "quantities_held_out": apart,
            "driving": driving,
            "i80": self.site,
            **totals(runs),
            "long_runs": runs,
            "long_runs_against": {
                name: runs for name, runs in self.long_runs.items() if name != self.traffic
            },
            "checks": checks,
        }


def card_rows(starts: Starts, traffic: str, resamples: int) -> dict[str, Any]:
    """The rows of a traffic's card, compared with every other traffic from the same starts."""
    floors = starts.reference.floors
    return quantity_rows(
        traffic, starts.driven, starts.recorded.counts, floors, starts.paired, resamples
    )


def quantity_rows(
    traffic: str,
    driven: Mapping[str, Measured],
    recorded: Mapping[str, Array],
    floors: Mapping[str, Mapping[str, float]],
    paired: bool = True,
    resamples: int = RESAMPLES,
) -> dict[str, Any]:
    """By quantity: distance, ceiling, floor, constant velocity, and the difference to each rival.

    Args:
        traffic: whose rows.
        driven: it and others from the same starts; all but :data:`FLOORS` are rivals.
        recorded: by quantity, [units, bins]; its quantities are the rows. Their halves give the
            ceilings.
        floors: by driver and quantity, where ``driven`` does not hold the driver.
        paired: whether the recorded units are those that were driven.
    """
    rivals = [name for name in driven if name != traffic and name not in FLOORS]
    ends = {**floors, **floors_of(driven, recorded)}
    rows = {}
    for name, counts in recorded.items():
        own, against = driven[traffic].counts[name], {}
        for rival in rivals:
            other = driven[rival].counts[name]
            difference = distance_difference(own, other, counts, paired, resamples)
            against[rival] = {
                **entries("distance", distance(other, counts, paired, resamples)),
                **entries("difference", difference),
                "verdict": verdict(difference),
            }
        rows[name] = {
            "unit": UNITS[name],
            **entries("distance", distance(own, counts, paired, resamples)),
            "ceiling": ceiling(counts),
            "floor": ends.get("random", {}).get(name),
            "constant_velocity": ends.get("constant_velocity", {}).get(name),
            "samples": int(own.sum()),
            "recorded_samples": int(counts.sum()),
            "against": against,
        }
    return rows


def floors_of(
    driven: Mapping[str, Measured], recorded: Mapping[str, Array]
) -> dict[str, dict[str, float]]:
    """Finite distances of the reference drivers in ``driven`` to the recordings, by driver and
    quantity.
    """
    found: dict[str, dict[str, float]] = {}
    for floor in (name for name in FLOORS if name in driven):
        values = {
            name: pooled_distance(driven[floor].counts[name], counts)
            for name, counts in recorded.items()
        }
        found[floor] = {name: value for name, value in values.items() if math.isfinite(value)}
    return found


def verdict(difference: Estimate) -> str:
    """``closer`` or ``farther`` where the interval of the difference leaves out 0, else
    ``undecided``.
    """
    if not difference.excludes_zero():
        return "undecided"
    return "closer" if difference.value < 0.0 else "farther"


def card_checks(
    quantities: Mapping[str, Any],
    own: Mapping[str, Any],
    recorded: Mapping[str, Any],
    recorded_rate: Sequence[float] | None,
    spread_mps: float,
    runs: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """The checks by name; None where the data to decide are missing.

    Args:
        quantities: the card's rows.
        own, recorded: quantiles of the traffic and of the recordings, from the same starts.
        recorded_rate: interval of the recorded lane changes per vehicle-km.
        spread_mps: recorded mean spread of speeds within a frame.
        runs: the long runs.
    """
    rivals: dict[str, dict[str, str]] = {}
    for name in CLOSER_IN:
        for other, row in quantities[name]["against"].items():
            rivals.setdefault(other, {})[name] = row["verdict"]
    pairs = [
        (own["acceleration"][level], recorded["acceleration"][level]) for level in ("0.05", "0.95")
    ]
    near = None
    if all(None not in pair for pair in pairs):
        near = all(abs(mine - theirs) <= 0.3 * abs(theirs) for mine, theirs in pairs)
    return {
        "compared_with": rivals,
        "acceleration_quantiles_within_30_percent": near,
        "long_runs": [_run_checks(run, recorded_rate, spread_mps) for run in runs],
    }


def _run_checks(
    run: Mapping[str, Any], recorded_rate: Sequence[float] | None, spread_mps: float
) -> dict[str, Any]:
    changes, overlaps = run["lane_changes_per_vehicle_km"], run["overlaps_per_1000_vehicle_km"]
    inside = None
    if changes is not None and recorded_rate:
        inside = recorded_rate[0] <= changes <= recorded_rate[1]
    spreads = [at["spread_mps"] for at in run["speeds"].values() if at["spread_mps"] is not None]
    wide = None if not spreads else min(spreads) >= 0.5 * spread_mps
    return {
        "vehicles": run["vehicles"],
        "lane_changes_inside_recorded_interval": inside,
        "overlaps_under_1_per_1000_vehicle_km": None if overlaps is None else overlaps < 1.0,
        "nobody_off_the_road": run["off_road"] == 0,
        "nobody_standing_in_free_flow": run["standstills_in_free_flow"] == 0,
        "spread_at_least_half_the_recorded": wide,
        "guard_under_5_percent": None if run["guard_share"] is None else run["guard_share"] < 0.05,
    }


def card_text(
    numbers: Mapping[str, Any], long_runs: Mapping[str, Sequence[Mapping[str, Any]]]
) -> list[str]:
    """The card's tables.

    Of the ``numbers`` in ``results.json``, and of the long runs of all traffics.
    """
    traffic = numbers["traffic"]
    tables = [quantities_table(numbers["quantities"], traffic)]
    if numbers["quantities_held_out"] is not None:
        tables.append(
            f"held-out scenes alone\n{quantities_table(numbers['quantities_held_out'], traffic)}"
        )
    tables.append(starts_table(numbers["driving"]))
    tables += [
        f"I-80, {name}\n{quantities_table(rows, traffic)}" for name, rows in numbers["i80"].items()
    ]
    tables += [long_table(runs, name) for name, runs in long_runs.items() if runs]
    return [*tables, checks_text(numbers["checks"])]


def document_text(
    tables: Sequence[str], numbers: Mapping[str, Any], command: str, written: str
) -> str:
    """A card's section of a document: command, machine, starts, tables."""
    here, code = machine(), code_version()
    revision = (
        f" ({code['revision'][:12]}{', modified' if code['modified'] else ''})"
        if code["revision"]
        else ""
    )
    excess = ", ".join(f"{name} {value:g}" for name, value in numbers["desired_above_mps"].items())
    paragraphs = [
        f"Written by the command on {written}:\n\n    {command}",
        f"Taken with Python {here['python']}, torch {here['torch']}, ganlane {code['version']}{revision}, from "
        f"{numbers['starts']} starts: {', '.join(numbers['scenes']) or 'none recorded'}. Desired speeds above the "
        f"speed at entry, mean, m/s: {excess or 'not fitted'}.",
    ]
    return "\n\n".join([*paragraphs, *(f"```text\n{table}\n```" for table in tables)])


def quantities_table(quantities: Mapping[str, Any], traffic: str) -> str:
    """Distances, one quantity per line.

    The traffic, the scale, and each rival with the difference to it.
    """
    others = list(next(iter(quantities.values()))["against"])
    heading = [
        "distance to recorded",
        f"{short_name(traffic)} [95 %]",
        "ceiling",
        "constant v",
        "random",
    ]
    for other in others:
        heading += [short_name(other), f"minus {short_name(other)} [95 %]", ""]
    lines = [heading]
    for name, row in quantities.items():
        scale = (number(row[key]) for key in ("ceiling", "constant_velocity", "floor"))
        line = [f"{name}, {row['unit']}", with_interval(row, "distance"), *scale]
        for other in others:
            rival = row["against"][other]
            line += [
                number(rival["distance"]),
                with_interval(rival, "difference"),
                rival["verdict"],
            ]
        lines.append(line)
    return aligned(lines)


def starts_table(driving: Mapping[str, Any]) -> str:
    """Lane changes and accelerations, one traffic per line, the recordings among them."""
    lines = [
        [
            "from the same starts",
            "changes per vehicle-km [95 %]",
            "vehicle-km",
            "acceleration 5 %, 95 %",
        ]
    ]
    for name, row in driving.items():
        tails = ", ".join(
            number(row["quantiles"]["acceleration"][level], 2) for level in ("0.05", "0.95")
        )
        rate, km = with_interval(row, "per_vehicle_km", 2), number(row["vehicle_km"], 1)
        lines.append([short_name(name), rate, km, tails])
    return aligned(lines)


def long_table(runs: Sequence[Mapping[str, Any]], traffic: str) -> str:
    """The long runs of a traffic, one column each."""
    cells = {
        f"{short_name(traffic)}, long runs": [f"{run['vehicles']} vehicles" for run in runs],
        "vehicle-km": [number(run["vehicle_km"], 0) for run in runs],
        "changes per vehicle-km": [
            with_interval(run, "lane_changes_per_vehicle_km", 2) for run in runs
        ],
        "overlaps per 1000 vehicle-km": [
            with_interval(run, "overlaps_per_1000_vehicle_km", 2) for run in runs
        ],
        "off road": [str(run["off_road"]) for run in runs],
        "standstills in free flow": [str(run["standstills_in_free_flow"]) for run in runs],
    }
    for time in runs[0]["speeds"]:
        at = [run["speeds"][time] for run in runs]
        speeds = [
            f"{number(each['mean_speed_mps'], 1)}, {number(each['spread_mps'], 2)}" for each in at
        ]
        cells[f"mean speed, spread after {time}, m/s"] = speeds
    for level in runs[0]["acceleration_quantiles"]:
        quantiles = [number(run["acceleration_quantiles"][level], 2) for run in runs]
        cells[f"acceleration, {100 * float(level):g} % quantile"] = quantiles
    shares = [run["guard_share"] for run in runs]
    cells["the guard's share"] = [
        "none" if share is None else percent(share, 1) for share in shares
    ]
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
    """A panel per quantity.

    The recorded density, and each traffic's, from counts [bins] (none where all are 0).
    """
    figure, grid = panel_grid(len(recorded))
    colours = {**palette(list(simulated)), "recorded": INK}
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
                        axes.plot(
                            middle[end], density[end], mark, color=colours[driver], clip_on=False
                        )
    beyond = Line2D([], [], color=FAINT, label="and all values beyond", marker=">", ls="")
    add_legend(figure, {"recorded": INK, **colours}, [beyond])
    return figure


@rc_context(STYLE)
def draw_distances(quantities: Mapping[str, Any], traffic: str) -> Figure:
    """The rows of :func:`ganlane.realism.card.quantity_rows`: a block per quantity, a line per
    traffic.

    Vertical lines are the ends of the scale: recordings against each other, and random driving.
    """
    others = list(next(iter(quantities.values()))["against"])
    colours = palette([traffic, *others])
    block = len(colours) + 1
    figure = Figure(figsize=(7.5, 0.8 + 0.125 * block * len(quantities)))
    axes = figure.subplots()
    axes.set(
        xlim=(0, 1),
        ylim=(block * len(quantities), 0),
        xlabel="Jensen-Shannon distance to recorded driving",
    )
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
    marks = [
        Line2D([], [], color=colour, label=name, marker="|", ls="", ms=10)
        for name, colour in ends.items()
    ]
    add_legend(figure, {short_name(name): colour for name, colour in colours.items()}, marks)
    return figure


@rc_context(STYLE)
def draw_speeds_over_time(runs: Sequence[Mapping[str, Any]], spread_mps: float) -> Figure:
    """Mean and spread of the speeds of long runs over time.

    The recorded mean spread within a frame as a level.
    """
    figure, grid = panel_grid(2)
    colours = palette([f"{run['vehicles']} vehicles" for run in runs])
    for axes, (key, title) in zip(
        grid, {"mean_speed_mps": "mean speed", "spread_mps": "spread of speeds"}.items()
    ):
        axes.set(title=title, xlabel="time, s", ylabel="m/s")
        for run, colour in zip(runs, colours.values()):
            timed = [
                (float(time.split()[0]), at[key])
                for time, at in run["speeds"].items()
                if time.endswith(" s")
            ]
            # None, where nobody was left to measure, becomes NaN
            x, y = np.array(timed, dtype=np.float64).T
            plot_line(axes, x, y, color=colour)
    grid[1].axhline(spread_mps, color=INK)
    add_legend(figure, {"recorded": INK, **colours})
    return figure


def draw(card: Card, to: Path) -> list[Path]:
    """The figures of a card, into the folder ``to``.

    Distributions, distances, and drift if there are long runs.
    """
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
