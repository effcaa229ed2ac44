"""How fast everybody would like to drive: fitted for every traffic by itself, since recordings do not show it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ganlane.evaluation.realism.distances import pooled_distance
from ganlane.evaluation.realism.driving import FLOORS, Report, drive, measure_recordings, units_of
from ganlane.evaluation.realism.quantities import QUANTITIES
from ganlane.evaluation.realism.recordings import Recording
from ganlane.evaluation.realism.simulation import Factory, StartOptions

#: Means tried for the desired speed's excess over the speed at entry, m/s.
EXCESS_GRID = (2.0, 4.0, 6.0, 8.0, 11.0, 15.0, 20.0)
#: What the excess is chosen by: all that needs no lane change.
FITTED_BY = tuple(name for name in QUANTITIES if name != "lane_change_duration")


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


def desired_speeds(
    makers: Mapping[str, Factory], fitted: Sequence[Recording], common: StartOptions, report: Report
) -> dict[str, StartOptions]:
    """How each traffic is driven: desired speeds fitted to ``fitted``, if there are any; floors as ``common``."""
    chosen = {name: common for name in FLOORS}
    for name, make in makers.items():
        chosen[name] = common
        if fitted:
            report(f"{name}: fitting desired speeds on {len(fitted)} scenes")
            chosen[name] = replace(common, desired_above_mps=fit_excess(make, fitted, common))
    return chosen


def mean_options(parts: Sequence[Mapping[str, StartOptions]], options: StartOptions) -> dict[str, StartOptions]:
    """By traffic, the mean of the folds' fitted desired speeds: for where no fold belongs."""
    means = {name: float(np.mean([part[name].desired_above_mps for part in parts])) for name in parts[0]}
    return {name: replace(options, desired_above_mps=excess) for name, excess in means.items()}
