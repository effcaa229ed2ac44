"""Summaries of measured quantities: quantiles, durations with censoring (Kaplan and Meier), and histograms."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

#: Levels of the stored quantiles: fine enough to sample from by linear interpolation.
LEVELS: Final = (0.01, *(round(0.05 * k, 2) for k in range(1, 20)), 0.99)


@dataclass(frozen=True)
class Distribution:
    """Number, mean, standard deviation and quantiles (at :data:`LEVELS`) of a sample, in its own unit.

    An empty sample has ``mean`` None and no quantiles; fewer than two samples have ``sd`` None.
    """

    count: int
    mean: float | None
    sd: float | None
    quantiles: tuple[float, ...]

    def quantile(self, level: float) -> float:
        """Value at ``level``, linear between :data:`LEVELS` and constant beyond them."""
        return float(np.interp(level, LEVELS, self.quantiles))


def describe(values: ArrayLike) -> Distribution:
    """Summarise a sample without NaN."""
    sample = np.asarray(values, dtype=np.float64)
    if not len(sample):
        return Distribution(0, None, None, ())
    sd = float(sample.std(ddof=1)) if len(sample) > 1 else None
    return Distribution(len(sample), float(sample.mean()), sd, tuple(float(q) for q in np.quantile(sample, LEVELS)))


@dataclass(frozen=True)
class Durations:
    """Durations of which some are censored, s.

    Attributes:
        complete: the complete ones; their mean is too low, since long durations are censored more often.
        censored: number of censored ones.
        survival_mean_s: area under Kaplan and Meier's survival curve, up to the longest duration; None
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
    mean = median = None
    if seen.any():
        ends, survival = survival_curve(times, seen)
        edges = np.concatenate(([0.0], ends, [max(times.max(), ends[-1])]))
        mean = float(np.sum(np.diff(edges) * np.concatenate(([1.0], survival))))
        halved = np.flatnonzero(survival <= 0.5)
        median = float(ends[halved[0]]) if len(halved) else None
    return Durations(describe(times[seen]), int(np.count_nonzero(~seen)), mean, median)


def survival_curve(duration_s: ArrayLike, complete: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Share of durations longer than each complete duration, estimated after Kaplan and Meier (1958).

    Args:
        duration_s: [C] durations.
        complete: [C] false where the duration is a lower bound.

    Returns:
        [E] the distinct complete durations, growing, and [E] the shares, falling.
    """
    times, seen = np.asarray(duration_s, dtype=np.float64), np.asarray(complete, bool)
    ends, ending = np.unique(times[seen], return_counts=True)
    at_risk = len(times) - np.searchsorted(np.sort(times), ends)
    return ends, np.cumprod(1.0 - ending / at_risk)


@dataclass(frozen=True)
class Bins:
    """Bins of equal width from ``low`` to ``high``; values beyond are counted in the outermost ones."""

    low: float
    high: float
    number: int

    @property
    def edges(self) -> np.ndarray:
        """[number + 1]."""
        return np.linspace(self.low, self.high, self.number + 1)


class Histogram:
    """Counts per bin, and exact number, mean and standard deviation, of samples that are added part by part.

    Args:
        bins: quantiles are interpolated linearly within a bin, so they are accurate to a bin's width.
    """

    def __init__(self, bins: Bins) -> None:
        self.bins = bins
        self.counts = np.zeros(bins.number, dtype=np.int64)
        self._sum = 0.0
        self._squares = 0.0

    @property
    def total(self) -> int:
        """Number of samples."""
        return int(self.counts.sum())

    def add(self, values: ArrayLike) -> None:
        """Count more samples, without NaN."""
        sample = np.asarray(values, dtype=np.float64)
        bins = self.bins
        self.counts += np.histogram(np.clip(sample, bins.low, bins.high), bins.number, (bins.low, bins.high))[0]
        self._sum += float(sample.sum())
        self._squares += float(np.square(sample).sum())

    def describe(self) -> Distribution:
        """As :func:`describe` of all samples, with quantiles accurate to a bin's width."""
        n = self.total
        if not n:
            return Distribution(0, None, None, ())
        mean = self._sum / n
        spread = math.sqrt(max(self._squares - n * mean * mean, 0.0) / (n - 1)) if n > 1 else None
        return Distribution(n, mean, spread, tuple(self.quantile(level) for level in LEVELS))

    def quantile(self, level: float) -> float:
        """Value at ``level``, linear within its bin."""
        below = np.concatenate(([0], np.cumsum(self.counts)))
        occupied = np.flatnonzero(self.counts)
        k = int(occupied[min(int(np.searchsorted(below[occupied + 1], level * self.total)), len(occupied) - 1)])
        share = (level * self.total - below[k]) / self.counts[k]
        edges = self.bins.edges
        return float(edges[k] + min(max(share, 0.0), 1.0) * (edges[k + 1] - edges[k]))

    def density(self) -> np.ndarray:
        """[number] probability density per unit of the quantity."""
        width = (self.bins.high - self.bins.low) / self.bins.number
        return self.counts / max(self.total, 1) / width
