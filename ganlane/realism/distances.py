"""How far one distribution is from another, with intervals by scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import stdtrit

from ganlane.evaluation.statistics import TAIL_LEVELS, Array, Estimate, resample_counts

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


def distance(
    simulated: Array, recorded: Array, paired: bool = True, resamples: int = RESAMPLES, seed: int = 0
) -> Estimate:
    """Distance with its 95 % bootstrap interval over units.

    A resample holds some units twice and others not at all, so its distance is biased upwards; near 0 all of them lie
    above the estimate. Hence the basic (reverse percentile) interval, taken of the squared distance, in which that
    bias adds up, cut off at 0 and widened to hold the estimate. Percentile and BCa intervals consist of resamples,
    none of which is 0, so they miss a perfect model's distance (``benchmarks/realism_coverage.py``).

    Args:
        simulated, recorded: [units, bins].
        paired: the units are the same and are resampled together; else ``simulated`` alone is.
        resamples, seed: of the bootstrap. One unit gives no interval.
    """
    value = pooled_distance(simulated, recorded)
    (drawn,) = _resampled((simulated,), recorded, paired, resamples, seed)
    known = drawn[np.isfinite(drawn)]
    if not np.isfinite(value) or len(known) < 2:
        return Estimate(value)
    tails = np.quantile(known**2, TAIL_LEVELS)
    low, high = np.sqrt(np.maximum(2.0 * value**2 - tails[::-1], 0.0))
    return Estimate(value, min(value, float(low)), min(1.0, max(value, float(high))))


def distance_difference(
    first: Array,
    second: Array,
    recorded: Array,
    paired: bool = True,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Estimate:
    """Distance of ``first`` less that of ``second`` to ``recorded``, with its 95 % interval; see :func:`distance`.

    ``first`` and ``second`` are of the same units and resampled together. The interval is Student's, from the
    bootstrap's standard error of the difference in squared distance, in which the bias of both mostly cancels,
    divided by the sum of the distances: (a^2 - b^2) / (a + b) = a - b. With four units the basic and the percentile
    interval find one of two equally good models closer too often.
    """
    one, other = pooled_distance(first, recorded), pooled_distance(second, recorded)
    ours, theirs = _resampled((first, second), recorded, paired, resamples, seed)
    known = (ours**2 - theirs**2)[np.isfinite(ours) & np.isfinite(theirs)]
    units, value = len(first), one - other
    if not np.isfinite(value) or len(known) < 2:
        return Estimate(value)
    error = float(known.std()) * np.sqrt(units / (units - 1))
    reach = float(stdtrit(units - 1, TAIL_LEVELS[1])) * error / max(one + other, _TINY)
    return Estimate(value, max(-1.0, value - reach), min(1.0, value + reach))


def _resampled(models: Sequence[Array], recorded: Array, paired: bool, resamples: int, seed: int) -> list[Array]:
    """Distances [R] of each of ``models`` from resampled units, the same ones for all; none of a single unit."""
    units = len(recorded) if paired else len(models[0])
    if units < 2:
        return [np.empty(0) for _ in models]
    drawn: list[list[Array]] = [[] for _ in models]
    for counts in resample_counts(units, resamples, seed):
        against = counts @ recorded if paired else recorded.sum(0)
        for values, model in zip(drawn, models):
            values.append(jensen_shannon(counts @ model, against))
    return [np.concatenate(values) for values in drawn]


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
