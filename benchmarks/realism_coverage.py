"""Do the realism card's intervals hold what they should? Models of which the true distance is
known, many times.

    python -m benchmarks.realism_coverage --scenes 11 4 --trials 200

Scenes have means of their own and sizes of their own; a recording and two models are drawn from
each of them, over and over. Printed is how often an interval holds the distance that scenes without
end would show (covers), how often it holds its own estimate, and how often a difference is called
closer or farther. Beside the card's intervals stand the percentile bootstrap's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from benchmarks.script import make_parser
from ganlane.evaluation.statistics import TAIL_LEVELS, Array, Estimate, resample_counts
from ganlane.realism.measures import distance, distance_difference, jensen_shannon

#: Spread of the scenes' means, and of the logarithm of their sizes; independent samples of a scene
#: of median size.
_BETWEEN, _SIZES, _MEDIAN = 0.7, 0.8, 20.0
#: A model drives every scene so often.
_REPEATS = 4
_EDGES = np.linspace(-4.0, 4.0, 21)
_MANY = 20_000


@dataclass(frozen=True)
class Model:
    """A normal quantity.

    Its mean in a scene lies by ``shift`` off the recorded one, where the spread is 1.
    """

    shift: float = 0.0
    spread: float = 1.0

    def shares(self, means: Array) -> Array:
        """Of the bins, [scenes, bins]."""
        inner = ndtr((_EDGES[1:-1] - means[:, None] - self.shift) / self.spread)
        return np.diff(np.pad(inner, ((0, 0), (1, 1)), constant_values=((0, 0), (0, 1))), axis=1)


RECORDED = Model()
#: Name to the two models that are compared.
PAIRS: Mapping[str, tuple[Model, Model]] = {
    "both perfect": (Model(), Model()),
    "perfect, off": (Model(), Model(0.3)),
    "equally off": (Model(0.5), Model(-0.5)),
    "unequally off": (Model(0.5), Model(0.0, 1.6)),
}


def scenes(number: int, random: np.random.Generator) -> tuple[Array, Array]:
    """Means and sizes of so many scenes."""
    return random.normal(0.0, _BETWEEN, number), np.maximum(
        5.0, random.lognormal(np.log(_MEDIAN), _SIZES, number)
    )


def truth(model: Model) -> float:
    """The distance that scenes without end would show."""
    means, sizes = scenes(_MANY, np.random.default_rng(0))
    pooled = [(sizes[:, None] * each.shares(means)).sum(0) for each in (model, RECORDED)]
    return float(jensen_shannon(*pooled))


def percentile(models: tuple[Array, ...], recorded: Array, resamples: int) -> Estimate:
    """Distance, or the difference of two, with its percentile interval."""
    signs = (1.0, -1.0)

    def value(counts: Array) -> Array:
        every = [jensen_shannon(counts @ model, counts @ recorded) for model in models]
        return np.sum([sign * each for sign, each in zip(signs, every)], axis=0)

    drawn = np.concatenate(
        [value(counts) for counts in resample_counts(len(recorded), resamples, 0)]
    )
    low, high = np.quantile(drawn, TAIL_LEVELS)
    return Estimate(float(value(np.ones(len(recorded)))), float(low), float(high))


def trial(
    pair: tuple[Model, Model], number: int, resamples: int, random: np.random.Generator
) -> list[Estimate]:
    """The intervals of one draw.

    Of a distance and of a difference, the card's and the percentile bootstrap's.
    """
    means, sizes = scenes(number, random)

    def drawn(model: Model, times: int) -> Array:
        return random.multinomial((times * sizes).astype(int), model.shares(means)).astype(
            np.float64
        )

    recorded, one, other = drawn(RECORDED, 1), drawn(pair[0], _REPEATS), drawn(pair[1], _REPEATS)
    own = distance(one, recorded, resamples=resamples)
    difference = distance_difference(one, other, recorded, resamples=resamples)
    plain = percentile((one,), recorded, resamples), percentile((one, other), recorded, resamples)
    return [own, plain[0], difference, plain[1]]


def holds(estimate: Estimate, value: float) -> bool:
    """Whether the interval holds a value."""
    return (
        estimate.low is not None
        and estimate.high is not None
        and estimate.low <= value <= estimate.high
    )


def shares(estimates: list[Estimate], true: float) -> str:
    """How often the interval covers, holds its estimate, and leaves 0 out below and above."""
    covers = np.mean([holds(each, true) for each in estimates])
    own = np.mean([holds(each, each.value) for each in estimates])
    closer = np.mean([each.excludes_zero() and each.value < 0.0 for each in estimates])
    farther = np.mean([each.excludes_zero() and each.value > 0.0 for each in estimates])
    return f"{covers:6.2f} {own:8.2f} {closer:7.2f} {farther:8.2f}"


def main() -> None:
    """Draw, and print a line per kind of interval."""
    asked = make_parser(__doc__)
    asked.add_argument("--scenes", type=int, nargs="+", default=[11, 4])
    asked.add_argument("--trials", type=int, default=200)
    asked.add_argument("--resamples", type=int, default=500)
    options = asked.parse_args()
    print(f"{'scenes, models, interval':52} covers estimate  closer  farther")
    for number in options.scenes:
        for name, pair in PAIRS.items():
            random, true = np.random.default_rng(0), [truth(model) for model in pair]
            rows = zip(
                *(trial(pair, number, options.resamples, random) for _ in range(options.trials))
            )
            kinds = ("distance", "distance, percentile", "difference", "difference, percentile")
            for kind, values, value in zip(
                kinds, rows, (true[0], true[0], true[0] - true[1], true[0] - true[1])
            ):
                print(f"{f'{number}, {name}, {kind}':52} {shares(list(values), value)}", flush=True)


if __name__ == "__main__":
    main()
