"""The numbers of a card: a traffic's distances to the recordings, and checks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ganlane.evaluation.statistics import (
    Array,
    Estimate,
    entries,
)
from ganlane.realism.driving import FLOORS
from ganlane.realism.long_runs import totals
from ganlane.realism.measures import (
    RESAMPLES,
    UNITS,
    Measured,
    ceiling,
    distance,
    distance_difference,
    pooled_distance,
)
from ganlane.realism.starts import Starts

#: Quantities in which generated traffic should come closer to recordings than rules do.
CLOSER_IN = (
    "speed_spread",
    "acceleration",
    "time_headway",
    "time_to_collision",
    "lane_change_duration",
)


def card_numbers(
    starts: Starts,
    site: Mapping[str, Any],
    long_runs: Mapping[str, list[dict[str, Any]]],
    resamples: int,
) -> dict[str, Any]:
    """The content of ``results.json``: all that tables and figures show but the histograms.

    Args:
        starts: every traffic from the same starts, the card's first.
        site: rows of a site that no generator was fitted to, by file; empty without it.
        long_runs: by traffic, a run per number of vehicles; at least the card's.
        resamples: of the bootstrap.
    """
    # The card's own traffic comes first everywhere.
    traffic = next(iter(starts.driven))
    rows = card_rows(starts, traffic, resamples)
    held_out = None
    if starts.separately_held_out:
        # What was fitted to the other scenes cannot help here.
        alone = starts.restricted_to(starts.separately_held_out)
        held_out = card_rows(alone, traffic, resamples)
    # The recordings are the first line of the table.
    driving = {"recorded": starts.recorded.summary()}
    for name, measured in starts.driven.items():
        driving[name] = measured.summary()
    runs = long_runs[traffic]
    rate = starts.reference.rate()["per_vehicle_km_ci"]
    ours = driving[traffic]["quantiles"]
    recorded = driving["recorded"]["quantiles"]
    return {
        "traffic": traffic,
        **starts.description(),
        "recorded_spread_mps": starts.reference.spread_mps,
        "quantities": rows,
        "quantities_held_out": held_out,
        "driving": driving,
        "i80": site,
        **totals(runs),
        "long_runs": runs,
        "long_runs_against": {name: long_runs[name] for name in long_runs if name != traffic},
        "checks": card_checks(
            rows,
            ours,
            recorded,
            rate,
            starts.reference.spread_mps,
            runs,
        ),
    }


def card_rows(
    starts: Starts,
    traffic: str,
    resamples: int,
) -> dict[str, Any]:
    """The rows of a traffic's card, compared with every other traffic from the same starts."""
    floors = starts.reference.floors
    recorded = starts.recorded.counts
    return quantity_rows(
        traffic,
        starts.driven,
        recorded,
        floors,
        starts.paired,
        resamples,
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
    # The reference drivers are the scale, not rivals.
    rivals = [name for name in driven if name != traffic and name not in FLOORS]
    # What was driven now comes before what ships.
    ends = {**floors, **floors_of(driven, recorded)}
    rows = {}
    for name, counts in recorded.items():
        ours = driven[traffic].counts[name]
        against = {}
        for rival in rivals:
            theirs = driven[rival].counts[name]
            difference = distance_difference(
                ours,
                theirs,
                counts,
                paired,
                resamples,
            )
            against[rival] = {
                **entries(
                    "distance",
                    distance(
                        theirs,
                        counts,
                        paired,
                        resamples,
                    ),
                ),
                **entries("difference", difference),
                "verdict": verdict(difference),
            }
        rows[name] = {
            "unit": UNITS[name],
            **entries(
                "distance",
                distance(
                    ours,
                    counts,
                    paired,
                    resamples,
                ),
            ),
            "ceiling": ceiling(counts),
            "floor": ends.get("random", {}).get(name),
            "constant_velocity": ends.get("constant_velocity", {}).get(name),
            "samples": int(ours.sum()),
            "recorded_samples": int(counts.sum()),
            "against": against,
        }
    return rows


def floors_of(
    driven: Mapping[str, Measured],
    recorded: Mapping[str, Array],
) -> dict[str, dict[str, float]]:
    """Finite distances of the reference drivers in ``driven`` to the recordings.

    By driver and quantity.
    """
    floors: dict[str, dict[str, float]] = {}
    for driver in (name for name in FLOORS if name in driven):
        floors[driver] = {}
        for name, counts in recorded.items():
            # A quantity without samples has no distance, and JSON no NaN.
            value = pooled_distance(driven[driver].counts[name], counts)
            if math.isfinite(value):
                floors[driver][name] = value
    return floors


def verdict(difference: Estimate) -> str:
    """``closer`` or ``farther`` where the interval of the difference leaves out 0.

    Else ``undecided``.
    """
    if not difference.excludes_zero():
        return "undecided"
    return "closer" if difference.value < 0.0 else "farther"


def card_checks(
    quantities: Mapping[str, Any],
    ours: Mapping[str, Any],
    recorded: Mapping[str, Any],
    recorded_rate: Sequence[float] | None,
    spread_mps: float,
    runs: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """The checks by name; None where the data to decide are missing.

    Args:
        quantities: the card's rows.
        ours, recorded: quantiles of the traffic and of the recordings, from the same starts.
        recorded_rate: interval of the recorded lane changes per vehicle-km.
        spread_mps: recorded mean spread of speeds within a frame.
        runs: the long runs.
    """
    # Verdicts by rival, of the quantities that matter most.
    rivals: dict[str, dict[str, str]] = {}
    for name in CLOSER_IN:
        for rival, row in quantities[name]["against"].items():
            rivals.setdefault(rival, {})[name] = row["verdict"]
    # Both tails of the accelerations.
    near: bool | None = True
    for level in ("0.05", "0.95"):
        value = ours["acceleration"][level]
        target = recorded["acceleration"][level]
        if value is None or target is None:
            near = None
            break
        near = near and abs(value - target) <= 0.3 * abs(target)
    return {
        "compared_with": rivals,
        "acceleration_quantiles_within_30_percent": near,
        "long_runs": [_run_checks(run, recorded_rate, spread_mps) for run in runs],
    }


def _run_checks(
    run: Mapping[str, Any],
    recorded_rate: Sequence[float] | None,
    spread_mps: float,
) -> dict[str, Any]:
    """The checks of one long run."""
    changes = run["lane_changes_per_vehicle_km"]
    overlaps = run["overlaps_per_1000_vehicle_km"]
    # Unknown until there is something to compare.
    inside = wide = None
    if changes is not None and recorded_rate:
        inside = recorded_rate[0] <= changes <= recorded_rate[1]
    # Speeds must not converge during minutes of driving.
    spreads = [at["spread_mps"] for at in run["speeds"].values() if at["spread_mps"] is not None]
    if spreads:
        wide = min(spreads) >= 0.5 * spread_mps
    return {
        "vehicles": run["vehicles"],
        "lane_changes_inside_recorded_interval": inside,
        "overlaps_under_1_per_1000_vehicle_km": None if overlaps is None else overlaps < 1.0,
        "nobody_off_the_road": run["off_road"] == 0,
        "nobody_standing_in_free_flow": run["standstills_in_free_flow"] == 0,
        "spread_at_least_half_the_recorded": wide,
        "guard_under_5_percent": None if run["guard_share"] is None else run["guard_share"] < 0.05,
    }
