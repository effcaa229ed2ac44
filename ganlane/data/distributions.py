"""Summaries of measured quantities as plain numbers, censored durations among them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

#: Levels of the quantiles kept: fine enough to draw from by linear interpolation.
LEVELS: Final = (0.01, *(round(0.05 * k, 2) for k in range(1, 20)), 0.99)


@dataclass(frozen=True)
class Distribution:
    """Number, mean, standard deviation and quantiles (at :data:`LEVELS`) of a sample, in its own unit.

    ``mean`` and ``quantiles`` of nothing, and ``sd`` of fewer than two, are None and empty.
    """

    count: int
    mean: float | None
    sd: float | None
    quantiles: tuple[float, ...]

    def quantile(self, level: float) -> float:
        """Value at ``level``, linear between :data:`LEVELS` and constant beyond them."""
        return float(np.interp(level, LEVELS, self.quantiles))


def describe(values: ArrayLike) -> Distribution:
    """Summarise a sample; NaN has no place in it."""
    sample = np.asarray(values, dtype=np.float64)
    if not len(sample):
        return Distribution(0, None, None, ())
    sd = float(sample.std(ddof=1)) if len(sample) > 1 else None
    return Distribution(len(sample), float(sample.mean()), sd, tuple(float(q) for q in np.quantile(sample, LEVELS)))


@dataclass(frozen=True)
class Durations:
    """Durations of which some were cut off, s.

    Attributes:
        complete: those seen from start to end; long ones are cut off more often, so their mean is too low.
        censored: how many were cut off.
        survival_mean_s: area under Kaplan and Meier's survival curve, up to the longest time seen; None
            without any complete one.
        survival_median_s: where that curve falls to one half; None if it never does.
    """

    complete: Distribution
    censored: int
    survival_mean_s: float | None
    survival_median_s: float | None


def describe_durations(duration_s: ArrayLike, complete: ArrayLike) -> Durations:
    """Summarise durations [C], of which those not ``complete`` [C] are lower bounds."""
    times, seen = np.asarray(duration_s, dtype=np.float64), np.asarray(complete, bool)
    mean, median = _survival(times, seen) if seen.any() else (None, None)
    return Durations(describe(times[seen]), int(np.count_nonzero(~seen)), mean, median)


def survival_curve(duration_s: ArrayLike, complete: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Share that lasts longer than each time at which one ended, by Kaplan and Meier (1958).

    Args:
        duration_s: [C] durations.
        complete: [C] false where the duration is a lower bound.

    Returns:
        [E] the times, growing, and [E] the shares, falling.
    """
    times, seen = np.asarray(duration_s, dtype=np.float64), np.asarray(complete, bool)
    ends = np.unique(times[seen])
    at_risk = len(times) - np.searchsorted(np.sort(times), ends)
    seen_times = np.sort(times[seen])
    ending = np.searchsorted(seen_times, ends, side="right") - np.searchsorted(seen_times, ends)
    return ends, np.cumprod(1.0 - ending / at_risk)


def _survival(times: np.ndarray, seen: np.ndarray) -> tuple[float, float | None]:
    """Restricted mean and median."""
    ends, survival = survival_curve(times, seen)
    edges = np.concatenate(([0.0], ends, [max(times.max(), ends[-1])]))
    mean = float(np.sum(np.diff(edges) * np.concatenate(([1.0], survival))))
    halved = np.flatnonzero(survival <= 0.5)
    return mean, float(ends[halved[0]]) if len(halved) else None
