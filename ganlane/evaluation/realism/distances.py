"""How far one distribution is from another, with intervals by scene."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ganlane.evaluation.statistics import Estimate, percentile_levels, resample_counts

Array = npt.NDArray[np.float64]

RESAMPLES = 2_000
#: Random halves of the recordings that the ceiling is the mean of.
SPLITS = 200
_TINY = 1e-300


def jensen_shannon(first: Array, second: Array) -> Array:
    """Jensen-Shannon distance of histograms [..., bins]: 0 for equal ones, 1 for disjoint ones (Lin 1991).

    The square root of the divergence to base 2, which is a metric (Endres and Schindelin 2003). NaN where either
    histogram is empty.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        p, q = first / first.sum(-1, keepdims=True), second / second.sum(-1, keepdims=True)
    middle = 0.5 * (p + q)

    def information(share: Array) -> Array:
        return np.sum(share * (np.log2(np.maximum(share, _TINY)) - np.log2(np.maximum(middle, _TINY))), axis=-1)

    return np.sqrt(np.clip(0.5 * (information(p) + information(q)), 0.0, 1.0))


def pooled_distance(simulated: Array, recorded: Array) -> float:
    """Distance of two sets of histograms [units, bins], each added up over its units."""
    return float(jensen_shannon(simulated.sum(0), recorded.sum(0)))


def _interval(value: float, drawn: Array) -> Estimate:
    known = drawn[np.isfinite(drawn)]
    if not np.isfinite(value) or len(known) < 2:
        return Estimate(value, None, None)
    low, high = np.quantile(known, percentile_levels())
    return Estimate(value, float(low), float(high))


def distance(
    simulated: Array, recorded: Array, paired: bool = True, resamples: int = RESAMPLES, seed: int = 0
) -> Estimate:
    """Distance with its percentile bootstrap interval over units.

    Args:
        simulated, recorded: [units, bins].
        paired: the units are the same and are resampled together; else ``simulated`` alone is.
        resamples, seed: of the bootstrap. One unit gives no interval.
    """
    value = pooled_distance(simulated, recorded)
    if len(simulated) < 2:
        return Estimate(value, None, None)
    drawn = [
        jensen_shannon(counts @ simulated, counts @ recorded if paired else recorded.sum(0))
        for counts in resample_counts(len(simulated), resamples, seed)
    ]
    return _interval(value, np.concatenate(drawn))


def distance_difference(
    first: Array,
    second: Array,
    recorded: Array,
    paired: bool = True,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Estimate:
    """Distance of ``first`` less that of ``second`` to ``recorded``, with its interval; see :func:`distance`.

    ``first`` and ``second`` are of the same units and resampled together.
    """
    value = pooled_distance(first, recorded) - pooled_distance(second, recorded)
    if len(first) < 2:
        return Estimate(value, None, None)
    drawn = []
    for counts in resample_counts(len(first), resamples, seed):
        against = counts @ recorded if paired else recorded.sum(0)
        drawn.append(jensen_shannon(counts @ first, against) - jensen_shannon(counts @ second, against))
    return _interval(value, np.concatenate(drawn))


def ceiling(recorded: Array, splits: int = SPLITS, seed: int = 0) -> float | None:
    """Mean distance of one half of the units [units, bins] to the other, over random halves; None for one unit.

    What no model can be expected to beat: halves hold half of the driving, so it errs on the high side.
    """
    units = len(recorded)
    if units < 2:
        return None
    generator = np.random.default_rng(seed)
    one = np.zeros((splits, units))
    for row in one:
        row[generator.permutation(units)[: units // 2]] = 1.0
    values = jensen_shannon(one @ recorded, (1.0 - one) @ recorded)
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else None
