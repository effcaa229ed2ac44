"""Samples of any number in little memory: counts per bin beside exact number, mean and standard deviation."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ganlane.data.distributions import LEVELS, Distribution


@dataclass(frozen=True)
class Bins:
    """Equal bins from ``low`` to ``high``; what lies beyond is counted in the outermost ones."""

    low: float
    high: float
    number: int

    @property
    def edges(self) -> np.ndarray:
        """[number + 1]."""
        return np.linspace(self.low, self.high, self.number + 1)


class Histogram:
    """Counts of a quantity, added up over scenes.

    Args:
        bins: quantiles are linear within a bin, so they are good to a bin's width.
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
        """Count more samples; NaN has no place among them."""
        sample = np.asarray(values, dtype=np.float64)
        bins = self.bins
        self.counts += np.histogram(np.clip(sample, bins.low, bins.high), bins.number, (bins.low, bins.high))[0]
        self._sum += float(sample.sum())
        self._squares += float(np.square(sample).sum())

    def describe(self) -> Distribution:
        """As :func:`ganlane.data.describe` of all samples, quantiles to a bin's width."""
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
        """[number] probability per unit of the quantity."""
        width = (self.bins.high - self.bins.low) / self.bins.number
        return self.counts / max(self.total, 1) / width
