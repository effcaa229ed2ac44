"""The realism card: every traffic driven from the same starts, held against the same recordings."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import polars as pl

from ganlane.evaluation.realism_distances import RESAMPLES, distance, distance_difference, pooled_distance
from ganlane.evaluation.realism_drivers import ConstantVelocity, RandomDriving
from ganlane.evaluation.realism_quantities import QUANTITIES, UNITS, Measured, measure
from ganlane.evaluation.realism_recordings import Recording, recorded_frame
from ganlane.evaluation.realism_reference import Reference, quantiles_of, rate
from ganlane.evaluation.realism_simulation import Factory, StartOptions, drive_recordings
from ganlane.evaluation.statistics import Estimate

#: The ends of the scale.
FLOORS: dict[str, Factory] = {"random": RandomDriving, "constant_velocity": ConstantVelocity}
#: Means tried for the desired speed's excess over the speed at entry, m/s.
EXCESS_GRID = (2.0, 4.0, 6.0, 8.0, 11.0, 15.0, 20.0)
#: What the excess is chosen by: all that needs no lane change.
FITTED_BY = tuple(name for name in QUANTITIES if name != "lane_change_duration")


@dataclass(frozen=True)
class Driven:
    """A traffic that drove: histograms [units, bins] by quantity, and what was measured."""

    counts: Mapping[str, np.ndarray]
    measured: Measured


def widths_of(frame: pl.DataFrame, recordings: Sequence[Recording]) -> dict[str, float]:
    """Lane width by the names of the frame's scenes (a recording's, with the run behind a ``#``)."""
    known = {each.name: each.lane_width_m for each in recordings}
    return {scene: known[scene.partition("#")[0]] for scene in frame["scene"].unique().to_list()}


def units_of(recordings: Sequence[Recording]) -> list[str]:
    """What is resampled, in order."""
    return list(dict.fromkeys(each.unit for each in recordings))


def measure_recordings(recordings: Sequence[Recording]) -> Measured:
    """The recordings, measured as simulations are."""
    frame = recorded_frame(recordings)
    return measure(frame, widths_of(frame, recordings))


def drive(make: Factory, recordings: Sequence[Recording], options: StartOptions) -> Driven:
    """Drive the recordings with a traffic and measure."""
    frame = drive_recordings(make, recordings, options)
    return driven_of(measure(frame, widths_of(frame, recordings)), units_of(recordings))


def driven_of(measured: Measured, units: Sequence[str]) -> Driven:
    """Measured driving with its histograms."""
    return Driven({quantity: measured.counts(units, quantity) for quantity in QUANTITIES}, measured)


def fit_excess(
    make: Factory, recordings: Sequence[Recording], options: StartOptions, grid: Sequence[float] = EXCESS_GRID
) -> float:
    """The mean excess of desired speeds at which a traffic comes nearest to ``recordings``, m/s, of ``grid``.

    Nearest by the mean distance over :data:`FITTED_BY`. Every traffic gets its own, so none is held back by desired
    speeds that were chosen for another.
    """
    recorded = measure_recordings(recordings)
    units = units_of(recordings)

    def mean_distance(excess: float) -> float:
        driven = drive(make, recordings, replace(options, desired_above_mps=excess, repeats=1))
        values = [pooled_distance(driven.counts[name], recorded.counts(units, name)) for name in FITTED_BY]
        return float(np.nanmean(values))

    return min(grid, key=mean_distance)


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


#: Told what begins.
Report = Callable[[str], None]


def drive_all(
    makers: Mapping[str, Factory],
    recordings: Sequence[Recording],
    options: Mapping[str, StartOptions],
    report: Report,
) -> dict[str, Driven]:
    """Every traffic and both ends of the scale from the same starts."""
    every = {**makers, **FLOORS}
    driven = {}
    for name, make in every.items():
        report(f"{name} from {len(recordings)} recorded starts")
        driven[name] = drive(make, recordings, options.get(name, StartOptions()))
    return driven
