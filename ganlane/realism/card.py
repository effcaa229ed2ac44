"""The numbers of a card: every traffic's distances to the same recordings, and what else was seen of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ganlane.evaluation.realism.distances import (
    RESAMPLES,
    ceiling,
    distance,
    distance_difference,
    pooled_distance,
)
from ganlane.evaluation.realism.driving import FLOORS, Driven
from ganlane.evaluation.realism.quantities import UNITS
from ganlane.evaluation.realism.reference import quantiles_of, rate
from ganlane.evaluation.realism.starts import Starts
from ganlane.evaluation.statistics import Estimate


def quantity_rows(
    driven: Driven,
    others: Mapping[str, Driven],
    recorded: Mapping[str, np.ndarray],
    floors: Mapping[str, Mapping[str, float]],
    paired: bool = True,
    resamples: int = RESAMPLES,
) -> dict[str, Any]:
    """By quantity: distance, ceiling, floor, constant velocity, and the difference to each of ``others``.

    Args:
        driven: the traffic.
        others: further traffics from the same starts; ``random`` and ``constant_velocity`` become the floors.
        recorded: by quantity, [units, bins]; its quantities are the rows. Their halves give the ceilings.
        floors: by driver and quantity, where ``others`` does not have it.
        paired: whether the recorded units are those that were driven.
        resamples: of the bootstrap.
    """
    rivals = {name: each for name, each in others.items() if name not in FLOORS}
    ends = {**floors, **floors_of({name: each for name, each in others.items() if name in FLOORS}, recorded)}
    return {
        name: {
            "unit": UNITS[name],
            **_estimate("distance", distance(driven.counts[name], counts, paired, resamples)),
            "ceiling": ceiling(counts),
            "floor": ends.get("random", {}).get(name),
            "constant_velocity": ends.get("constant_velocity", {}).get(name),
            "samples": int(driven.counts[name].sum()),
            "recorded_samples": int(counts.sum()),
            "against": {
                rival: _against(driven.counts[name], each.counts[name], counts, paired, resamples)
                for rival, each in rivals.items()
            },
        }
        for name, counts in recorded.items()
    }


def floors_of(driven: Mapping[str, Driven], recorded: Mapping[str, np.ndarray]) -> dict[str, dict[str, float]]:
    """Distances of both ends of the scale, by driver and quantity; those that there are."""
    rows = {
        floor: {name: pooled_distance(driven[floor].counts[name], counts) for name, counts in recorded.items()}
        for floor in FLOORS
        if floor in driven
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


def rows_of(starts: Starts, traffic: str, resamples: int = RESAMPLES) -> dict[str, Any]:
    """The rows of a traffic's card, by quantity: held against everybody else from the same starts."""
    others = {name: each for name, each in starts.driven.items() if name != traffic}
    floors = starts.reference.floors
    return quantity_rows(starts.driven[traffic], others, starts.recorded, floors, starts.paired, resamples)


def from_starts(driven: Mapping[str, Driven]) -> dict[str, Any]:
    """What else was seen of each traffic: lane changes per vehicle-km and the quantiles of every quantity."""
    return {
        name: {
            **rate(sum(each.measured.lane_changes.values()), sum(each.measured.vehicle_km.values())),
            "quantiles": quantiles_of(each.measured),
        }
        for name, each in driven.items()
    }
