"""Statistics with the training as the unit: several trainings of one recipe (seeds) on the same episodes.

An interval over episodes says what other episodes would give; it says nothing about another training. Here both are
resampled: the trainings of a recipe, and the episodes, which are the same for all trainings and drivers and so are
drawn once for all of them. Tables are [S, E]: S trainings (1 for a driver that is not trained), E episodes.

A plain bootstrap of three to five trainings is too narrow: where trainings differ, its intervals hold the truth in 75
to 91 of 100 draws. :func:`_estimate` corrects it as a t interval would.

Sources: Agarwal et al. 2021 (interquartile mean, bootstrap, probability of improvement); Owen 2007 (resampling both
factors of a crossed table); Hesterberg 2015 (how much too narrow the bootstrap of few values is); Satterthwaite 1946
(degrees of freedom of a sum of variances); McNemar 1947, in its exact form.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import binomtest, norm, t, trim_mean

from ganlane.evaluation.statistics import TAIL_LEVELS, Array, Estimate, kept_counts, poisson_interval

#: Fewer than for one mean, since every cell of a matrix needs several of these.
RESAMPLES = 2000
_MEAN: Callable[[Array], Any] = partial(np.mean, axis=-1)


def interquartile_mean(scores: npt.ArrayLike) -> Array:
    """Mean of the middle half of the last axis; a quarter, rounded down, is left out at each end."""
    return np.asarray(trim_mean(np.asarray(scores, dtype=np.float64), 0.25, axis=-1))


def over_trainings(scores: npt.ArrayLike, statistic: Callable[[Array], Any] = _MEAN, seed: int = 0) -> Estimate:
    """``statistic`` (over the last axis) of the mean scores of trainings [S, E], with its interval.

    No interval where there is one training and one episode.
    """
    return _estimate([_table(scores)], statistic, seed)


def difference(first: npt.ArrayLike, second: npt.ArrayLike, seed: int = 0) -> Estimate:
    """Mean of ``first`` [S, E] minus mean of ``second`` [S', E], on the same episodes."""
    return _estimate(_pair(first, second), lambda a, b: a.mean(axis=-1) - b.mean(axis=-1), seed)


def probability_of_improvement(first: npt.ArrayLike, second: npt.ArrayLike, seed: int = 0) -> Estimate:
    """How likely a training of ``first`` [S, E] has a higher mean score than one of ``second`` [S', E]; ties half.

    Where all trainings at hand of one are above all of the other it is 1, from 1 to 1: it says nothing of others.
    """
    return _estimate(_pair(first, second), _share_above, seed, bounds=(0.0, 1.0))


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

    def ratio(both: Array) -> Array:
        sums = both.sum(axis=-1)
        return np.asarray(sums[:, 0] / np.maximum(sums[:, 1], np.finfo(np.float64).tiny))

    # One table, so that a draw of trainings is one for events and kilometres.
    return _estimate([np.stack([happened, amount])], ratio, seed, bounds=(0.0, np.inf))


def normalized_over_trainings(
    agent: npt.ArrayLike, mobil: npt.ArrayLike, random_legal: npt.ArrayLike, seed: int = 0
) -> Estimate | None:
    """The normalised score (:func:`ganlane.evaluation.normalized_percent`) of several trainings, each [S, E].

    None where the interval of MOBIL's lead over the random driver includes 0: the scale would have no length.
    """
    tables = [_pair(each, mobil)[0] for each in (agent, mobil, random_legal)]
    if not difference(tables[1], tables[2], seed).excludes_zero():
        return None

    def percent(*scores: Array) -> Array:
        value, top, bottom = (each.mean(axis=-1) for each in scores)
        return np.asarray(100.0 * (value - bottom) / (top - bottom))

    return _estimate(tables, percent, seed)


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


def _estimate(
    tables: Sequence[Array],
    statistic: Callable[..., Array],
    seed: int,
    bounds: tuple[float, float] = (-np.inf, np.inf),
) -> Estimate:
    """``statistic`` of the trainings' means of ``tables`` [..., S, E], with its interval within ``bounds``.

    ``statistic`` takes means [R, ..., S] of every table and returns [R]. The episodes and each table's trainings are
    resampled apart. S resampled trainings have (S - 1) / S of the variance that they should have, and few trainings
    tell it badly. So each table's part is widened by the root of S / (S - 1), and the sum of all parts by Student's t
    over the normal distribution, with Satterthwaite's degrees of freedom (infinite for the episodes).
    """
    means = [table.mean(axis=-1)[None] for table in tables]
    value = float(statistic(*means)[0])
    if all(table.shape[-2:] == (1, 1) for table in tables):
        return Estimate(value)
    generator, episodes = np.random.default_rng((seed, 1)), tables[0].shape[-1]
    counts = np.concatenate(kept_counts(episodes, RESAMPLES, seed)).astype(np.float64).T
    parts = [statistic(*(np.moveaxis(table @ counts, -1, 0) / episodes for table in tables)) - value]
    freedom = [np.inf]
    for index, table in enumerate(tables):
        trainings = table.shape[-2]
        if trainings == 1:
            continue
        chosen = generator.integers(trainings, size=(RESAMPLES, trainings))
        drawn = list(means)
        drawn[index] = np.moveaxis(means[index][0][..., chosen], -2, 0)
        parts.append(np.sqrt(trainings / (trainings - 1)) * (statistic(*drawn) - value))
        freedom.append(trainings - 1)
    variances = np.var(parts, axis=-1)
    uncertainty = float((variances**2 / freedom).sum())
    degrees = variances.sum() ** 2 / uncertainty if uncertainty > 0.0 else np.inf
    wider = t.ppf(TAIL_LEVELS[1], degrees) / norm.ppf(TAIL_LEVELS[1])
    low, high = np.clip(value + wider * np.quantile(np.sum(parts, axis=0), TAIL_LEVELS), *bounds)
    return Estimate(value, float(low), float(high))


def _share_above(first: Array, second: Array) -> Array:
    """Share of the pairs of [R, S] and [R, S'] in which the first is above; [R]."""
    a, b = first[:, :, None], second[:, None, :]
    return np.asarray(((a > b) + 0.5 * (a == b)).mean(axis=(1, 2)))
