"""Drives traffics from recorded starts, measures them, and fits their desired speeds.

Recordings do not show how fast drivers would like to go, so the mean desired speed is fitted for every traffic.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from ganlane.realism.distances import pooled_distance
from ganlane.realism.quantities import QUANTITIES, Measured, measure
from ganlane.realism.recordings import Recording, recorded_frame
from ganlane.realism.references import ConstantVelocity, RandomDriving
from ganlane.realism.replay_starts import Factory, StartOptions, drive_recordings

#: Reference drivers at the ends of the scale.
FLOORS: dict[str, Factory] = {"random": RandomDriving, "constant_velocity": ConstantVelocity}
#: Called with a line of progress.
Report = Callable[[str], None]
#: Candidates for the mean excess of desired speeds over the speed at entry, m/s.
EXCESS_GRID = (2.0, 4.0, 6.0, 8.0, 11.0, 15.0, 20.0)
#: Quantities by which the excess is chosen: all that need no lane change.
FITTED_BY = tuple(name for name in QUANTITIES if name != "lane_change_duration")


@dataclass(frozen=True)
class Driven:
    """The driving of one traffic: histograms [units, bins] by quantity, and the samples."""

    counts: Mapping[str, np.ndarray]
    measured: Measured


def widths_of(frame: pl.DataFrame, recordings: Sequence[Recording]) -> dict[str, float]:
    """Lane width by the names of the frame's scenes (a recording's, with the run behind a ``#``)."""
    known = {each.name: each.lane_width_m for each in recordings}
    return {scene: known[scene.partition("#")[0]] for scene in frame["scene"].unique().to_list()}


def units_of(recordings: Sequence[Recording]) -> list[str]:
    """Names of the units that the bootstrap resamples, in order."""
    return list(dict.fromkeys(each.unit for each in recordings))


def measure_recordings(recordings: Sequence[Recording]) -> Measured:
    """The recordings, measured as simulations are."""
    frame = recorded_frame(recordings)
    return measure(frame, widths_of(frame, recordings))


def drive(make: Factory, recordings: Sequence[Recording], options: StartOptions) -> Driven:
    """Drive the recordings with a traffic and measure it."""
    frame = drive_recordings(make, recordings, options)
    return driven_from(measure(frame, widths_of(frame, recordings)), units_of(recordings))


def driven_from(measured: Measured, units: Sequence[str]) -> Driven:
    """Measured driving with its histograms."""
    return Driven({quantity: measured.counts(units, quantity) for quantity in QUANTITIES}, measured)


def drive_all(
    factories: Mapping[str, Factory],
    recordings: Sequence[Recording],
    options: Mapping[str, StartOptions],
    report: Report,
) -> dict[str, Driven]:
    """Drives every traffic and both reference drivers from the same starts."""
    every = {**factories, **FLOORS}
    driven = {}
    for name, make in every.items():
        report(f"{name} from {len(recordings)} recorded starts")
        driven[name] = drive(make, recordings, options.get(name, StartOptions()))
    return driven


def fit_excess(
    make: Factory, recordings: Sequence[Recording], options: StartOptions, grid: Sequence[float] = EXCESS_GRID
) -> float:
    """The mean excess of desired speeds at which a traffic comes nearest to ``recordings``, m/s, of ``grid``.

    Nearest by the mean distance over :data:`FITTED_BY`. Every traffic is fitted, so that none suffers from desired
    speeds chosen for another.
    """
    recorded = measure_recordings(recordings)
    units = units_of(recordings)

    def mean_distance(excess: float) -> float:
        driven = drive(make, recordings, replace(options, desired_above_mps=excess, repeats=1))
        values = [pooled_distance(driven.counts[name], recorded.counts(units, name)) for name in FITTED_BY]
        return float(np.nanmean(values))

    return min(grid, key=mean_distance)


def desired_speeds(
    factories: Mapping[str, Factory], fitted: Sequence[Recording], common: StartOptions, report: Report
) -> dict[str, StartOptions]:
    """Options by traffic: desired speeds fitted to ``fitted``, if there are any; reference drivers as ``common``."""
    chosen = {name: common for name in FLOORS}
    for name, make in factories.items():
        chosen[name] = common
        if fitted:
            report(f"{name}: fitting desired speeds on {len(fitted)} scenes")
            chosen[name] = replace(common, desired_above_mps=fit_excess(make, fitted, common))
    return chosen


def mean_options(parts: Sequence[Mapping[str, StartOptions]], options: StartOptions) -> dict[str, StartOptions]:
    """By traffic, the mean over folds of the fitted desired speeds, for sites that belong to no fold."""
    means = {name: float(np.mean([part[name].desired_above_mps for part in parts])) for name in parts[0]}
    return {name: replace(options, desired_above_mps=excess) for name, excess in means.items()}
