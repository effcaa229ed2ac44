"""95 % intervals: the bootstrap for means, exact ones for rare events, and both for several
trainings of a recipe.

All bootstraps are seeded and vectorised: a resample is a row of counts (how often each episode was
drawn), so a mean over thousands of resamples is one matrix product, and paired episodes stay
together.

Sources: Efron 1987 (BCa); Clopper and Pearson 1934 (binomial); Garwood 1936 (Poisson); Agarwal et
al. 2021 (interquartile mean, bootstrap, probability of improvement); Owen 2007 (resampling both
factors of a crossed table); Hesterberg 2015 (how much too narrow the bootstrap of few values is);
Satterthwaite 1946 (degrees of freedom of a sum of variances); McNemar 1947, in its exact form;
Fisher 1935 (sign flips of paired differences); Cochran 1977 (standard error of a ratio of sums).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy  # scipy.stats, which takes a second to import, comes with its first use
from scipy.special import betaincinv

from ganlane.data.statistics import poisson_interval as poisson_bounds

Array = npt.NDArray[np.float64]

#: Of a bootstrap over episodes alone, and of a sign-flip test.
RESAMPLES = 10_000
#: Over trainings, since every cell of a matrix needs several of these.
FEWER_RESAMPLES = 2000
_CONFIDENCE = 0.95
#: Probability of each tail of a 95 % interval, and the levels at which it is cut off.
_TAIL = (1.0 - _CONFIDENCE) / 2.0
TAIL_LEVELS = np.array([_TAIL, (1.0 + _CONFIDENCE) / 2.0])
#: Resamples held in memory at once.
_CHUNK = 500
#: Counts that are kept for the next interval, 2 bytes each.
_MOST_KEPT = 20_000_000
_NORMAL = NormalDist()


def _mean(scores: Array) -> Array:
    """Means over the last axis."""
    return np.asarray(scores.mean(axis=-1))


@dataclass(frozen=True)
class Estimate:
    """A value with its 95 % interval.

    Attributes:
        value: of the data at hand.
        low: lower bound of the interval; None where the data are too few.
        high: upper bound; None where ``low`` is.
    """

    value: float
    low: float | None = None
    high: float | None = None

    @property
    def interval(self) -> list[float] | None:
        """``[low, high]``, or None."""
        if self.low is None or self.high is None:
            return None
        return [self.low, self.high]

    def excludes_zero(self) -> bool:
        """Whether there is an interval and 0 lies outside it."""
        if self.low is None or self.high is None:
            return False
        return not self.low <= 0.0 <= self.high

    def scaled(self, factor: float = 1.0, per: float = 1.0) -> Estimate:
        """Value and bounds times ``factor``, divided by ``per``; both are positive."""
        low = None if self.low is None else self.low * factor / per
        high = None if self.high is None else self.high * factor / per
        return Estimate(self.value * factor / per, low, high)


def entries(name: str, estimate: Estimate | None) -> dict[str, Any]:
    """``{name: value, name_ci: [low, high]}`` for a table's row.

    None for what is missing, and for a value that is not finite: JSON has no NaN.
    """
    if estimate is None:
        return {name: None, f"{name}_ci": None}
    return {
        name: estimate.value if math.isfinite(estimate.value) else None,
        f"{name}_ci": estimate.interval,
    }


def resample_counts(size: int, resamples: int) -> Iterator[Array]:
    """Chunks [R, size] of how often each of ``size`` episodes occurs in a resample of ``size`` with
    replacement.

    The draws depend on both numbers alone; all chunks together have ``resamples`` rows.
    """
    generator = np.random.default_rng(0)
    for start in range(0, resamples, _CHUNK):
        rows = min(_CHUNK, resamples - start)
        drawn = generator.integers(size, size=(rows, size))

        # Each row of a chunk counts in a range of its own, so that one bincount serves all rows.
        drawn += size * np.arange(rows)[:, None]
        counts = np.bincount(drawn.ravel(), minlength=rows * size)
        yield counts.reshape(rows, size).astype(np.float64)


@lru_cache(maxsize=2)
def kept_counts(size: int, resamples: int) -> tuple[npt.NDArray[np.uint16], ...]:
    """The chunks of :func:`resample_counts`, for the next interval, in a quarter of the memory.

    A table's intervals draw the same ones, which takes 0.25 s for 1000 episodes.
    """
    return tuple(counts.astype(np.uint16) for counts in resample_counts(size, resamples))


def bootstrap_means(values: Array) -> Array:
    """Means over resampled episodes.

    Args:
        values: of E episodes, [E] or [E, K]; the K columns of an episode stay together.

    Returns:
        [R] or [R, K], with R = :data:`RESAMPLES`. Values of equally many episodes get the same
        draws.
    """
    size = len(values)

    # All tables of one evaluation have the same number of episodes, so the draws are shared.
    counts: Iterable[npt.NDArray[Any]] = resample_counts(size, RESAMPLES)
    if size * RESAMPLES <= _MOST_KEPT:
        counts = kept_counts(size, RESAMPLES)

    # A mean is one row of counts times the values.
    return np.concatenate([chunk.astype(np.float64) @ values / size for chunk in counts])


def _bca_levels(values: Array, means: Array) -> Array:
    """Tail levels corrected for bias and skewness for the mean of ``values`` [E], not all equal.

    ``means`` [R] are the bootstrapped means.
    """
    mean = values.mean()
    centred = values - mean

    # The jackknife's acceleration; for a mean the leave-one-out values differ from it by -centred /
    # (E - 1).
    acceleration = (centred**3).sum() / (6.0 * (centred**2).sum() ** 1.5)

    # The bias: the share of resamples below the mean, ties half, as a normal quantile.
    below = ((means < mean).mean() + (means <= mean).mean()) / 2.0
    # Half a resample away from 0 and 1, where the normal quantile is infinite.
    edge = 0.5 / len(means)
    bias = _NORMAL.inv_cdf(float(np.clip(below, edge, 1.0 - edge)))

    # Efron's corrected levels: without bias and acceleration they are the tail levels themselves.
    levels = []
    for level in TAIL_LEVELS:
        shifted = bias + _NORMAL.inv_cdf(float(level))
        levels.append(_NORMAL.cdf(bias + shifted / (1.0 - acceleration * shifted)))
    return np.array(levels)


def mean_interval(values: npt.ArrayLike) -> Estimate:
    """Mean of ``values`` [E], at least one, with its BCa bootstrap interval.

    A single value has no interval. That of equal values has no width.
    """
    data = np.asarray(values, dtype=np.float64)
    mean = float(data.mean())
    if len(data) < 2:
        return Estimate(mean)

    # Where all are equal the correction below would divide by zero.
    if np.all(data == data[0]):
        return Estimate(mean, mean, mean)

    means = bootstrap_means(data)
    low, high = np.quantile(means, _bca_levels(data, means))
    return Estimate(mean, float(low), float(high))


def paired_difference(first: npt.ArrayLike, second: npt.ArrayLike) -> Estimate:
    """Mean of ``first - second`` over the same episodes, in the same order, with its interval."""
    return mean_interval(np.subtract(first, second, dtype=np.float64))


def sign_flip_p(differences: npt.ArrayLike) -> float:
    """Two-sided probability of a sum of ``differences`` [E] so far from 0 between equal drivers.

    If two drivers are equal, each difference of their episodes could as well have the other sign,
    whatever its distribution. So the test holds its level also where a few crashes make up the sum,
    which a bootstrap cannot know. Monte Carlo over :data:`RESAMPLES` draws of signs.
    """
    data = np.asarray(differences, dtype=np.float64)
    # Sums of equal numbers in another order differ in their last bits.
    reached = (1.0 - 1e-9) * abs(float(data.sum()))

    # Signs of their own, apart from the draws of the bootstrap.
    generator = np.random.default_rng((0, 2))
    # How many draws were as far from 0; the data's own signs count as one of them, so that the
    # probability is never 0.
    as_far = 1
    for start in range(0, RESAMPLES, _CHUNK):
        rows = min(_CHUNK, RESAMPLES - start)
        # From 0 and 1 to -1 and 1.
        signs = generator.integers(2, size=(rows, len(data)), dtype=np.int8) * 2.0 - 1.0
        sums = signs @ data
        as_far += int((np.abs(sums) >= reached).sum())

    return as_far / (RESAMPLES + 1)


def clopper_pearson(count: int, trials: int) -> Estimate:
    """Share ``count / trials`` with its exact binomial interval.

    Args:
        count: how often it happened, from 0 to ``trials``.
        trials: how often it could have happened, at least once.
    """
    # The bounds are quantiles of beta distributions; the function knows neither end.
    low = 0.0 if count == 0 else float(betaincinv(count, trials - count + 1, _TAIL))
    high = 1.0 if count == trials else float(betaincinv(count + 1, trials - count, 1.0 - _TAIL))
    return Estimate(count / trials, low, high)


def poisson_interval(count: int) -> Estimate:
    """``count`` observed events with the exact Poisson interval of their expected number.

    Divided by what was driven (:meth:`Estimate.scaled`) it is a rate.
    """
    return Estimate(float(count), *poisson_bounds(count))


# The training as the unit: several trainings of one recipe (seeds) on the same episodes.
#
# An interval over episodes says what other episodes would give; it says nothing about another
# training. Here both are resampled: the trainings of a recipe, and the episodes, which are the same
# for all trainings and drivers and so are drawn once for all of them. Tables are [S, E]: S
# trainings (1 for a driver that is not trained), E episodes. A plain bootstrap of three to five
# trainings is too narrow: where trainings differ, its intervals hold the truth in 75 to 91 of 100
# draws. _estimate corrects it as a t interval would.


def interquartile_mean(scores: npt.ArrayLike) -> Array:
    """Mean of the middle half of the last axis: without a quarter, rounded down, at both ends."""
    values = np.asarray(scores, np.float64)
    return np.asarray(scipy.stats.trim_mean(values, 0.25, axis=-1))


def over_trainings(scores: npt.ArrayLike, statistic: Callable[[Array], Array] = _mean) -> Estimate:
    """A statistic of the mean scores of trainings, with its interval.

    Args:
        scores: of S trainings in E episodes, [S, E].
        statistic: of the trainings' means, over the last axis.

    Returns:
        No interval where there is one training and one episode.
    """
    return _estimate([_table(scores)], statistic)


def difference(first: npt.ArrayLike, second: npt.ArrayLike) -> Estimate:
    """Mean of ``first`` [S, E] minus mean of ``second`` [S', E], on the same episodes.

    The interval is over the episodes, drawn together, and the trainings of both, drawn apart.
    """
    return _estimate(_pair(first, second), lambda a, b: _mean(a) - _mean(b))


def rate_over_trainings(events: npt.ArrayLike, per: npt.ArrayLike) -> Estimate | None:
    """All events of S trainings in E episodes, over all that they happened in.

    The interval is never narrower than Poisson's exact one for all events together. With several
    trainings its lower bound is at most that of the resampled trainings, and its upper bound is at
    least that of Student's interval on the logarithm's scale: rates of trainings are skewed, so a
    symmetric interval misses high ones.

    Args:
        events: how many happened, [S, E].
        per: in how much of what the rate is per, say km, [S, E].

    Returns:
        None where the whole of ``per`` is 0.
    """
    happened, amount = _pair(events, per)
    total = float(amount.sum())
    if not total > 0.0:
        return None
    if not happened.any():
        # Resampling zeros would leave no doubt.
        return poisson_interval(0).scaled(per=total)

    def ratio(both: Array) -> Array:
        # Events and amounts, [R, 2]: the trainings' means [R, 2, S] added up.
        sums = both.sum(axis=-1)
        driven = sums[:, 1] > 0.0
        # A draw without a kilometre says nothing about the rate.
        rates = np.full(len(sums), happened.sum() / total)
        rates[driven] = sums[driven, 0] / sums[driven, 1]
        return rates

    # One table, so that a draw of trainings is one for events and kilometres.
    table = np.stack([happened, amount])
    resampled = _estimate([table], ratio, bounds=(0.0, np.inf))
    rate = resampled.value

    # Poisson's exact interval for all events together.
    low, high = (bound / total for bound in poisson_bounds(round(happened.sum())))

    # One episode of one training has no spread to resample.
    if resampled.low is None or resampled.high is None:
        return Estimate(rate, low, high)

    above = resampled.high - rate
    trainings = len(happened)
    if trainings > 1:
        # Cochran's standard error of a ratio, from the trainings' own deviations.
        deviations = happened.sum(axis=-1) - rate * amount.sum(axis=-1)
        squares = float((deviations**2).sum())
        error = math.sqrt(trainings / (trainings - 1) * squares) / total
        # Student's reach above the rate, laid off on the logarithm's scale.
        quantile = float(scipy.stats.t.ppf(TAIL_LEVELS[1], trainings - 1))
        above = max(above, error * quantile)
        high = max(high, rate * math.exp(above / rate))
    return Estimate(rate, min(low, resampled.low), max(high, resampled.high))


def score_over_traffics(traffics: Sequence[Sequence[npt.ArrayLike]]) -> Estimate:
    """Interquartile mean over traffics of the normalised score of several trainings.

    Args:
        traffics: for each the rewards [S, E] of the agent, of the driver with score 100 and of that
            with score 0, on the same episodes; S is the same on all traffics.
    """

    def middle(*means: Array) -> Array:
        # Three tables per traffic, in a row: agent, top, bottom.
        scores = []
        for at in range(0, len(means), 3):
            agent, top, bottom = map(_mean, means[at : at + 3])
            scores.append(percent_of_way(agent, top, bottom))
        return interquartile_mean(np.stack(scores, axis=-1))

    # Each on the episodes of the traffic's first driver.
    tables = [_pair(rewards, drivers[0])[0] for drivers in traffics for rewards in drivers]
    return _estimate(tables, middle, recipes=[0, 1, 2] * len(traffics))


def improvement_over_traffics(
    traffics: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]],
) -> Estimate:
    """How likely a training of one recipe has a higher mean score than one of another; ties half.

    Where all trainings at hand of one are above all of the other it is 1, from 1 to 1: it says
    nothing of others.

    Args:
        traffics: for each the scores [S, E] and [S', E] of both recipes, on the same episodes; S
            and S' are the same on all traffics.

    Returns:
        The mean of the probabilities over ``traffics``, from 0 to 1.
    """

    def share(*means: Array) -> Array:
        # Two tables per traffic, in a row.
        pairs = zip(means[::2], means[1::2])
        shares = [_share_above(first, second) for first, second in pairs]
        return np.mean(shares, axis=0)

    tables = [table for pair in traffics for table in _pair(*pair)]
    return _estimate(tables, share, bounds=(0.0, 1.0), recipes=[0, 1] * len(traffics))


def percent_of_way(value: Array, top: Array, bottom: Array) -> Array:
    """How far ``value`` is on the way from ``bottom`` to ``top``, in per cent; all of one shape.

    Below 0 before ``bottom``, above 100 beyond ``top``; not finite where both are equal.
    """
    return np.asarray(100.0 * (value - bottom) / (top - bottom))


@dataclass(frozen=True)
class McNemar:
    """Episodes in which one of two drivers alone failed.

    Attributes:
        only_first: episodes in which the first failed and the second did not.
        only_second: the other way round.
        p_value: the exact two-sided probability of so unequal numbers between equal drivers.
    """

    only_first: int
    only_second: int
    p_value: float


def mcnemar(first: npt.ArrayLike, second: npt.ArrayLike) -> McNemar:
    """Exact test whether two drivers fail equally often.

    Args:
        first, second: whether each failed, [E] bool, on the same episodes.

    Raises:
        ValueError: they have not the same shape.
    """
    a = np.asarray(first, dtype=bool)
    b = np.asarray(second, dtype=bool)
    if a.shape != b.shape:
        raise ValueError(f"paired episodes must have one shape, found {a.shape} and {b.shape}")

    # Episodes in which both failed, or neither, say nothing about a difference.
    one = int((a & ~b).sum())
    other = int((b & ~a).sum())
    if one + other == 0:
        return McNemar(0, 0, 1.0)

    # Between equal drivers each of these episodes is a toss of a coin.
    test = scipy.stats.binomtest(one, one + other)
    return McNemar(one, other, float(test.pvalue))


def _table(values: npt.ArrayLike) -> Array:
    """``values`` as a table [S, E] of doubles; ValueError where they are none."""
    table = np.asarray(values, dtype=np.float64)
    if table.ndim != 2 or table.size == 0:
        raise ValueError(f"expected a table of trainings and episodes, [S, E], found {table.shape}")
    return table


def _pair(first: npt.ArrayLike, second: npt.ArrayLike) -> tuple[Array, Array]:
    """Tables [S, E] and [S', E]; ValueError where their episodes differ in number."""
    a = _table(first)
    b = _table(second)
    if a.shape[1] != b.shape[1]:
        raise ValueError(f"expected the same episodes, found {a.shape[1]} and {b.shape[1]}")
    return a, b


def _estimate(
    tables: Sequence[Array],
    statistic: Callable[..., Array],
    bounds: tuple[float, float] = (-np.inf, np.inf),
    recipes: Sequence[int] | None = None,
) -> Estimate:
    """``statistic`` of the trainings' means, with its interval by the bootstrap.

    The episodes and each table's trainings are resampled apart. S resampled trainings have
    (S - 1) / S of the variance that they should have, and few trainings tell it badly. So each
    table's part is widened by the root of S / (S - 1), and the sum of all parts by Student's t over
    the normal distribution, with Satterthwaite's degrees of freedom (infinite for the episodes).

    Args:
        tables: scores [..., S, E]; S may differ between them. Episodes are drawn together by
            number.
        statistic: takes means [R, ..., S] of every table and returns [R].
        bounds: the interval is cut off there.
        recipes: a number per table. Tables with one number are of the same trainings, on several
            traffics, and those are drawn together; None: all are of different ones.

    Returns:
        No interval where there is one training and one episode.
    """
    # The value itself is of one draw, R = 1: the trainings and episodes at hand.
    means = [table.mean(axis=-1)[None] for table in tables]
    value = float(statistic(*means)[0])
    if all(table.shape[-2:] == (1, 1) for table in tables):
        return Estimate(value)

    # Deviations [R] from the value, each with its degrees of freedom: first those of other
    # episodes, then those of other trainings of each recipe.
    parts = [statistic(*map(_resampled_means, tables)) - value]
    freedom = [np.inf]

    generator = np.random.default_rng((0, 1))
    numbers = list(range(len(tables)) if recipes is None else recipes)
    # In the order of the tables, since every recipe takes the generator's next numbers.
    for recipe in dict.fromkeys(numbers):
        places = [place for place, number in enumerate(numbers) if number == recipe]
        trainings = tables[places[0]].shape[-2]
        if trainings == 1:
            continue

        # The trainings of this recipe are drawn anew, the others' stay as they are.
        chosen = generator.integers(trainings, size=(FEWER_RESAMPLES, trainings))
        drawn = list(means)
        for place in places:
            # From [..., S] by way of [..., R, S] to [R, ..., S].
            drawn[place] = np.moveaxis(means[place][0][..., chosen], -2, 0)

        # Hesterberg: without this factor a bootstrap of S values is too narrow.
        widening = np.sqrt(trainings / (trainings - 1))
        parts.append(widening * (statistic(*drawn) - value))
        freedom.append(trainings - 1)

    # Satterthwaite: the degrees of freedom of a sum of variances that are known unequally well.
    variances = np.var(parts, axis=-1)
    uncertainty = float((variances**2 / freedom).sum())
    degrees = variances.sum() ** 2 / uncertainty if uncertainty > 0.0 else np.inf

    # All parts of a draw together, widened as Student's t is wider than the normal distribution.
    wider = scipy.stats.t.ppf(TAIL_LEVELS[1], degrees) / scipy.stats.norm.ppf(TAIL_LEVELS[1])
    deviations = np.quantile(np.sum(parts, axis=0), TAIL_LEVELS)
    low, high = np.clip(value + wider * deviations, *bounds)
    return Estimate(value, float(low), float(high))


def _resampled_means(table: Array) -> Array:
    """Means [R, ..., S] over resampled episodes of a table [..., S, E]."""
    episodes = table.shape[-1]

    # The same draws for all tables of E episodes: all drivers drove the same ones.
    counts = np.concatenate(kept_counts(episodes, FEWER_RESAMPLES)).astype(np.float64)
    sums = table @ counts.T
    return np.moveaxis(sums, -1, 0) / episodes


def _share_above(first: Array, second: Array) -> Array:
    """Share of the pairs of [R, S] and [R, S'] in which the first is above; [R]."""
    # Every training of the first with every training of the second, [R, S, S'].
    a = first[:, :, None]
    b = second[:, None, :]
    # Ties count half.
    above = (a > b) + 0.5 * (a == b)
    return np.asarray(above.mean(axis=(1, 2)))
