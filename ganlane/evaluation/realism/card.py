"""The numbers of a card: every traffic's distances to the same recordings, and what else was seen of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ganlane.evaluation.realism.distances import RESAMPLES, distance, distance_difference, pooled_distance
from ganlane.evaluation.realism.driving import FLOORS, Driven
from ganlane.evaluation.realism.quantities import QUANTITIES, UNITS
from ganlane.evaluation.realism.reference import Reference, quantiles_of, rate
from ganlane.evaluation.statistics import Estimate


def quantity_rows(
    driven: Driven,
    others: Mapping[str, Driven],
    recorded: Mapping[str, np.ndarray],
    reference: Reference | None,
    paired: bool = True,
    quantities: Sequence[str] = tuple(QUANTITIES),
    resamples: int = RESAMPLES,
) -> dict[str, Any]:
    """By quantity: distance, ceiling, floor, constant velocity, and the difference to each of ``others``.

    Args:
        driven: the traffic.
        others: further traffics from the same starts; ``random`` and ``constant_velocity`` become the floors.
        recorded: by quantity, [units, bins].
        reference: gives ceilings, and the floors where ``others`` has none; None where there are none.
        paired: whether the recorded units are those that were driven.
        quantities: which.
        resamples: of the bootstrap.
    """
    ceilings = reference.ceilings if reference else {}
    shipped = reference.floors if reference else {}
    rows = {}
    for name in quantities:
        own = distance(driven.counts[name], recorded[name], paired, resamples)
        floors = {
            floor: pooled_distance(others[floor].counts[name], recorded[name])
            if floor in others
            else shipped.get(floor, {}).get(name)
            for floor in FLOORS
        }
        rows[name] = {
            "unit": UNITS[name],
            **_estimate("distance", own),
            "ceiling": ceilings.get(name),
            "floor": _known(floors["random"]),
            "constant_velocity": _known(floors["constant_velocity"]),
            "samples": int(driven.counts[name].sum()),
            "recorded_samples": int(recorded[name].sum()),
            "against": {
                other: _against(driven.counts[name], rival.counts[name], recorded[name], paired, resamples)
                for other, rival in others.items()
                if other not in FLOORS
            },
        }
    return rows


def floors_of(driven: Mapping[str, Driven], recorded: Mapping[str, np.ndarray]) -> dict[str, dict[str, float]]:
    """Distances of both ends of the scale, by driver and quantity; those that there are."""
    rows = {
        floor: {name: pooled_distance(driven[floor].counts[name], counts) for name, counts in recorded.items()}
        for floor in FLOORS
    }
    return {
        floor: {name: value for name, value in row.items() if math.isfinite(value)} for floor, row in rows.items()
    }


def _against(
    own: np.ndarray, other: np.ndarray, recorded: np.ndarray, paired: bool, resamples: int
) -> dict[str, Any]:
    """Another traffic's distance, and the difference to it."""
    theirs = distance(other, recorded, paired, resamples)
    difference = distance_difference(own, other, recorded, paired, resamples)
    return {**_estimate("distance", theirs), **_estimate("difference", difference), "verdict": verdict(difference)}


def verdict(difference: Estimate) -> str:
    """``closer`` or ``farther`` where the interval of the difference leaves out 0, else ``undecided``."""
    if not difference.excludes_zero():
        return "undecided"
    return "closer" if difference.value < 0.0 else "farther"


def _estimate(name: str, estimate: Estimate) -> dict[str, Any]:
    return {name: _known(estimate.value), f"{name}_ci": estimate.interval}


def _known(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def from_starts(driven: Mapping[str, Driven]) -> dict[str, Any]:
    """What else was seen of each traffic: lane changes per vehicle-km and the quantiles of every quantity."""
    return {
        name: {
            **rate(sum(each.measured.lane_changes.values()), sum(each.measured.vehicle_km.values())),
            "quantiles": quantiles_of(each.measured),
        }
        for name, each in driven.items()
    }
