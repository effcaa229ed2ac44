"""Statistics with the training as the unit: several trainings of one recipe (seeds) on the same episodes.

An interval over episodes says what other episodes would give; it says nothing about another training. Here both are
resampled: the trainings of a recipe, and the episodes, which are the same for all trainings and drivers and so are
drawn once for all of them. Tables are [S, E]: S trainings (1 for a driver that is not trained), E episodes.

Sources: Agarwal et al. 2021 (interquartile mean, bootstrap, probability of improvement); Owen 2007
(resampling both factors of a crossed table); McNemar 1947, in its exact form.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import binomtest, trim_mean

from ganlane.evaluation.statistics import TAIL_LEVELS, Array, Estimate, kept_counts, poisson_interval

#: Fewer than for one mean, since every cell of a matrix needs several of these.
RESAMPLES = 2000
_MEAN: Callable[[Array], Any] = partial(np.mean, axis=-1)


def interquartile_mean(scores: npt.ArrayLike) -> Array:
    """Mean of the middle half of the last axis; a quarter, rounded down, is left out at each end."""
    return np.asarray(trim_mean(np.asarray(scores, dtype=np.float64), 0.25, axis=-1))


def over_trainings(scores: npt.ArrayLike, statistic: Callable[[Array], Any] = _MEAN, seed: int = 0) -> Estimate:
    """``statistic`` (over the last axis) of the mean scores of trainings [S, E], with the bootstrap's interval.

    No interval where there is one training and one episode.
    """
    table = _table(scores)
    resampled = statistic(_resampled([table], seed)[0])
    return _interval(float(statistic(table.mean(axis=1))), resampled, table.size == 1)


def difference(first: npt.ArrayLike, second: npt.ArrayLike, seed: int = 0) -> Estimate:
    """Mean of ``first`` [S, E] minus mean of ``second`` [S', E], on the same episodes."""
    a, b = _pair(first, second)
    resampled = [drawn.mean(axis=1) for drawn in _resampled([a, b], seed)]
    return _interval(float(a.mean() - b.mean()), resampled[0] - resampled[1], a.shape == b.shape == (1, 1))


def probability_of_improvement(first: npt.ArrayLike, second: npt.ArrayLike, seed: int = 0) -> Estimate:
    """How likely a training of ``first`` [S, E] has a higher mean score than one of ``second`` [S', E]; ties half."""
    a, b = _pair(first, second)
    value = float(_share_above(a.mean(axis=1)[None], b.mean(axis=1)[None])[0])
    return _interval(value, _share_above(*_resampled([a, b], seed)), a.shape == b.shape == (1, 1))


def rate_over_trainings(events: npt.ArrayLike, per: npt.ArrayLike, seed: int = 0) -> Estimate | None:
    """All events over all of ``per`` (km, say), both [S, E]; None where the latter is 0.

    Where nothing happened the upper bound is Poisson's exact one, since resampling zeros gives zero.
    """
    happened, amount = _pair(events, per)
    total = float(amount.sum())
    if not total > 0.0:
        return None
    if not happened.any():
        return Estimate(0.0, 0.0, (poisson_interval(0).high or 0.0) / total)
    # One draw of trainings for both: the ratio is taken within it.
    (both,) = _resampled([np.stack([happened, amount])], seed)
    sums = both.sum(axis=-1)
    ratios = sums[:, 0] / np.maximum(sums[:, 1], np.finfo(np.float64).tiny)
    return _interval(float(happened.sum()) / total, ratios, happened.size == 1)


def normalized_over_trainings(
    agent: npt.ArrayLike, mobil: npt.ArrayLike, random_legal: npt.ArrayLike, seed: int = 0
) -> Estimate | None:
    """The normalised score (:func:`ganlane.evaluation.normalized_percent`) of several trainings, each [S, E].

    None where the interval of MOBIL's lead over the random driver includes 0: the scale would have no length.
    """
    tables = [_pair(each, mobil)[0] for each in (agent, mobil, random_legal)]
    if not difference(tables[1], tables[2], seed).excludes_zero():
        return None
    drawn = [each.mean(axis=1) for each in _resampled(tables, seed)]
    value, top, bottom = (float(each.mean()) for each in tables)
    percent = 100.0 * (drawn[0] - drawn[2]) / (drawn[1] - drawn[2])
    return _interval(100.0 * (value - bottom) / (top - bottom), percent[np.isfinite(percent)], False)


@dataclass(frozen=True)
class McNemar:
    """Episodes in which one of two drivers alone failed; the exact two-sided probability of so unequal numbers."""

    only_first: int
    only_second: int
    p_value: float


def mcnemar(first: npt.ArrayLike, second: npt.ArrayLike) -> McNemar:
    """Exact test whether two drivers fail equally often: ``first`` and ``second`` [E] bool on the same episodes."""
    a, b = np.asarray(first, dtype=bool), np.asarray(second, dtype=bool)
    if a.shape != b.shape:
        raise ValueError(f"paired episodes must have one shape, found {a.shape} and {b.shape}")
    one, other = int((a & ~b).sum()), int((b & ~a).sum())
    return McNemar(one, other, float(binomtest(one, one + other).pvalue) if one + other else 1.0)


def _table(values: npt.ArrayLike) -> Array:
    table = np.asarray(values, dtype=np.float64)
    if table.ndim != 2 or table.size == 0:
        raise ValueError(f"expected a table of trainings and episodes, [S, E], found {table.shape}")
    return table


def _pair(first: npt.ArrayLike, second: npt.ArrayLike) -> tuple[Array, Array]:
    a, b = _table(first), _table(second)
    if a.shape[1] != b.shape[1]:
        raise ValueError(f"expected the same episodes, found {a.shape[1]} and {b.shape[1]}")
    return a, b


def _resampled(tables: Sequence[Array], seed: int) -> list[Array]:
    """Mean scores [R, ..., S] of resampled trainings of each table [..., S, E], on the same resampled episodes."""
    generator, episodes = np.random.default_rng((seed, 1)), tables[0].shape[-1]
    counts = np.concatenate(kept_counts(episodes, RESAMPLES, seed)).astype(np.float64)
    drawn = []
    for table in tables:
        means = np.moveaxis(table @ counts.T, -1, 0) / episodes
        chosen = generator.integers(table.shape[-2], size=(RESAMPLES, table.shape[-2]))
        chosen = chosen.reshape(RESAMPLES, *[1] * (table.ndim - 2), -1)
        drawn.append(np.take_along_axis(means, np.broadcast_to(chosen, means.shape), axis=-1))
    return drawn


def _share_above(first: Array, second: Array) -> Array:
    """Share of the pairs of [R, S] and [R, S'] in which the first is above; [R]."""
    a, b = first[:, :, None], second[:, None, :]
    return ((a > b) + 0.5 * (a == b)).mean(axis=(1, 2))


def _interval(value: float, resampled: Array, single: bool) -> Estimate:
    if single:
        return Estimate(value)
    low, high = np.quantile(resampled, TAIL_LEVELS)
    return Estimate(value, float(low), float(high))
