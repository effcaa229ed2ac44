"""Intervals and comparisons of returns, by the bootstrap.

All intervals are seeded and vectorised: a resample is a row of counts (how often each episode was drawn), so
a mean over thousands of resamples is one matrix product, and episodes that are paired stay together.

Sources: Efron 1987 (BCa); Agarwal et al. 2021 (interquartile mean, probability of improvement).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from statistics import NormalDist
from typing import Literal

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Method = Literal["bca", "percentile"]

RESAMPLES = 10_000
CONFIDENCE = 0.95
#: Resamples held in memory at once.
_CHUNK = 500
_NORMAL = NormalDist()


@dataclass(frozen=True)
class Estimate:
    """A value with its interval; the bounds are None where too little was seen to give one."""

    value: float
    low: float | None
    high: float | None

    @property
    def interval(self) -> list[float] | None:
        """``[low, high]``, or None."""
        return None if self.low is None or self.high is None else [self.low, self.high]

    def excludes_zero(self) -> bool:
        """Whether there is an interval and 0 lies outside it."""
        return self.low is not None and self.high is not None and not self.low <= 0.0 <= self.high


def resample_counts(size: int, resamples: int, seed: int) -> Iterator[Array]:
    """Chunks [R, size] of how often each of ``size`` episodes occurs in a resample of ``size`` with replacement."""
    generator = np.random.default_rng(seed)
    for start in range(0, resamples, _CHUNK):
        rows = min(_CHUNK, resamples - start)
        drawn = generator.integers(size, size=(rows, size)) + size * np.arange(rows)[:, None]
        yield np.bincount(drawn.ravel(), minlength=rows * size).reshape(rows, size).astype(np.float64)


def bootstrap_means(values: Array, resamples: int = RESAMPLES, seed: int = 0) -> Array:
    """Means [R] or [R, K] of resampled ``values`` [E] or [E, K]; the K columns of an episode stay together."""
    size = len(values)
    return np.concatenate([counts @ values / size for counts in resample_counts(size, resamples, seed)])


def percentile_levels(confidence: float = CONFIDENCE) -> Array:
    """The two tail levels of an equal-tailed interval, for instance 0.025 and 0.975."""
    return np.array([(1.0 - confidence) / 2.0, (1.0 + confidence) / 2.0])


def bca_levels(values: Array, means: Array, confidence: float = CONFIDENCE) -> Array:
    """Tail levels corrected for bias and skewness (Efron 1987) for the mean of ``values`` [E].

    Args:
        values: the observations; not all equal.
        means: their bootstrapped means [R].
        confidence: of the interval.
    """
    centred = values - values.mean()
    # The jackknife's acceleration; for a mean the leave-one-out values differ from it by -centred / (E - 1).
    acceleration = (centred**3).sum() / (6.0 * (centred**2).sum() ** 1.5)
    mean = values.mean()
    below = ((means < mean).mean() + (means <= mean).mean()) / 2.0
    edge = 0.5 / len(means)
    bias = _NORMAL.inv_cdf(float(np.clip(below, edge, 1.0 - edge)))
    shifted = [bias + _NORMAL.inv_cdf(float(level)) for level in percentile_levels(confidence)]
    return np.array([_NORMAL.cdf(bias + z / (1.0 - acceleration * z)) for z in shifted])


def mean_interval(
    values: npt.ArrayLike,
    method: Method = "bca",
    resamples: int = RESAMPLES,
    seed: int = 0,
    confidence: float = CONFIDENCE,
) -> Estimate:
    """Mean of ``values`` [E] with its bootstrap interval; no interval for fewer than two values."""
    data = np.asarray(values, dtype=np.float64)
    mean = float(data.mean())
    if len(data) < 2:
        return Estimate(mean, None, None)
    if np.all(data == data[0]):
        return Estimate(mean, mean, mean)
    means = bootstrap_means(data, resamples, seed)
    levels = bca_levels(data, means, confidence) if method == "bca" else percentile_levels(confidence)
    low, high = np.quantile(means, levels)
    return Estimate(mean, float(low), float(high))


def paired_difference(
    first: npt.ArrayLike, second: npt.ArrayLike, method: Method = "bca", **options: float
) -> Estimate:
    """Mean of ``first - second`` over the same episodes, in the same order, with its interval."""
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if a.shape != b.shape:
        raise ValueError(f"paired values must have one shape, found {a.shape} and {b.shape}")
    return mean_interval(a - b, method, **options)  # type: ignore[arg-type]


def interquartile_means(rows: Array) -> Array:
    """Mean of the middle half along the last axis: a quarter of the values is cut off at either end."""
    ordered = np.sort(rows, axis=-1)
    cut = rows.shape[-1] // 4
    return ordered[..., cut : rows.shape[-1] - cut].mean(axis=-1)


def interquartile_mean(values: npt.ArrayLike, resamples: int = RESAMPLES, seed: int = 0) -> Estimate:
    """Interquartile mean of ``values`` [E] with its percentile interval: less moved by rare crashes than the mean."""
    data = np.asarray(values, dtype=np.float64)
    value = float(interquartile_means(data))
    if len(data) < 2:
        return Estimate(value, None, None)
    generator, means = np.random.default_rng(seed), []
    for start in range(0, resamples, _CHUNK):
        drawn = generator.integers(len(data), size=(min(_CHUNK, resamples - start), len(data)))
        means.append(interquartile_means(data[drawn]))
    low, high = np.quantile(np.concatenate(means), percentile_levels())
    return Estimate(value, float(low), float(high))


def probability_of_improvement(
    first: npt.ArrayLike, second: npt.ArrayLike, resamples: int = 2_000, seed: int = 0
) -> Estimate:
    """P(a value of ``first`` [A] exceeds one of ``second`` [B]), ties counted half, with its percentile interval."""
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    wins = (a[:, None] > b) + 0.5 * (a[:, None] == b)
    value = float(wins.mean())
    if min(len(a), len(b)) < 2:
        return Estimate(value, None, None)
    pairs = zip(resample_counts(len(a), resamples, seed), resample_counts(len(b), resamples, seed + 1))
    resampled = np.concatenate([((drawn_a @ wins) * drawn_b).sum(axis=1) for drawn_a, drawn_b in pairs])
    low, high = np.quantile(resampled / wins.size, percentile_levels())
    return Estimate(value, float(low), float(high))
