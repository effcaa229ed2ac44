"""The numbers of a card: a traffic's distances to the recordings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from ganlane.evaluation.statistics import Estimate, entries
from ganlane.realism.driving import FLOORS
from ganlane.realism.long_runs import totals
from ganlane.realism.measures import (
    QUANTITIES,
    ceiling,
    distance,
    distance_difference,
    pooled_distance,
)
from ganlane.realism.starts import Starts


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

    Returns:
        Of the starts the name of the ``traffic``, how it was started (``starts``), the ``scenes``
        and those ``held_out``, and ``desired_above_mps`` by traffic; of the recordings their source
        (``recordings``), ``recorded_lane_changes_per_vehicle_km`` and ``recorded_spread_mps``;
        ``quantities`` of :func:`card_rows` over all scenes, and ``quantities_held_out`` over those
        alone (None without any); ``driving`` by name, as
        :meth:`ganlane.realism.measures.Measured.summary` gives it; the ``site`` as ``i80``; and the
        ``long_runs`` of the traffic with their totals, beside ``long_runs_against`` of its rivals.
    """
    # The card's own traffic comes first everywhere.
    traffic = next(iter(starts.driven))
    runs = long_runs[traffic]
    others = {name: long_runs[name] for name in long_runs if name != traffic}

    # What was fitted to the other scenes cannot help on these.
    held_out = starts.held_out_alone()
    quantities_held_out = card_rows(held_out, resamples) if held_out else None

    # The recordings are the first line of the table.
    measured = {"recorded": starts.recorded, **starts.driven}
    recorded = starts.reference

    return {
        "traffic": traffic,
        "starts": "recorded" if starts.paired else "spawned",
        "scenes": starts.scenes,
        "held_out": starts.held_out,
        "desired_above_mps": dict(starts.desired_above_mps),
        "recordings": recorded.source,
        "recorded_lane_changes_per_vehicle_km": recorded.rate(),
        "recorded_spread_mps": recorded.whole["speed_spread_mps"],
        "quantities": card_rows(starts, resamples),
        "quantities_held_out": quantities_held_out,
        "driving": {name: driving.summary() for name, driving in measured.items()},
        "i80": site,
        **totals(runs),
        "long_runs": runs,
        "long_runs_against": others,
    }


def card_rows(starts: Starts, resamples: int) -> dict[str, Any]:
    """The rows of the first traffic from the same starts, by quantity that was recorded.

    Args:
        starts: the traffic, its rivals and the reference drivers.
        resamples: of the bootstrap.

    Returns:
        Of each quantity its ``unit``; the ``distance`` of the traffic to the recordings, from 0 to
        1; the ends of the scale, ``ceiling`` (of the recordings' halves), ``floor`` (random
        driving) and ``constant_velocity``, None where they are unknown; ``samples`` and
        ``recorded_samples``; and ``against``, of each rival its ``distance``, the ``difference`` of
        the traffic to it and the :func:`verdict` on that. A key with ``_ci`` holds the 95 %
        interval of its namesake.
    """
    driven = starts.driven
    paired = starts.paired
    traffic, *others = driven
    # The reference drivers are the scale, not rivals.
    rivals = [name for name in others if name not in FLOORS]

    # What was driven now comes before what ships.
    ends = {**starts.reference.floors, **floors_of(starts)}
    random = ends.get("random", {})
    constant_velocity = ends.get("constant_velocity", {})

    rows = {}
    for name, counts in starts.recorded.counts.items():
        ours = driven[traffic].counts[name]
        distance_of_ours = distance(ours, counts, paired, resamples)

        # Below 0 the traffic is closer to the recordings than the rival.
        against = {}
        for rival in rivals:
            theirs = driven[rival].counts[name]
            difference = distance_difference(ours, theirs, counts, paired, resamples)
            against[rival] = {
                **entries("distance", distance(theirs, counts, paired, resamples)),
                **entries("difference", difference),
                "verdict": verdict(difference),
            }

        rows[name] = {
            "unit": QUANTITIES[name].unit,
            **entries("distance", distance_of_ours),
            "ceiling": ceiling(counts),
            "floor": random.get(name),
            "constant_velocity": constant_velocity.get(name),
            "samples": int(ours.sum()),
            "recorded_samples": int(counts.sum()),
            "against": against,
        }
    return rows


def floors_of(starts: Starts) -> dict[str, dict[str, float]]:
    """Finite distances to the recordings of the reference drivers that were driven.

    By driver and quantity.
    """
    floors = {}
    recorded = starts.recorded.counts
    # Spawned starts are not driven by them.
    for driver in (name for name in FLOORS if name in starts.driven):
        counts = starts.driven[driver].counts
        distances = {name: pooled_distance(counts[name], recorded[name]) for name in recorded}

        # A quantity without samples has no distance, and JSON no NaN.
        floors[driver] = {name: at for name, at in distances.items() if math.isfinite(at)}
    return floors


def verdict(difference: Estimate) -> str:
    """``closer`` or ``farther`` where the interval of the difference leaves out 0.

    Else ``undecided``.
    """
    if not difference.excludes_zero():
        return "undecided"
    return "closer" if difference.value < 0.0 else "farther"
