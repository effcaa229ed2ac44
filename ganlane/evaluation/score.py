"""The paper's '% of MOBIL', in the form that fits both rows of its Table VII.

A plain ratio of mean rewards has no meaning where rewards can be negative. ``100 (R - R_0) / (R_MOBIL - R_0)``
has: 0 for the driver that picks legal actions at random, 100 for MOBIL.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ganlane.evaluation.statistics import (
    RESAMPLES,
    bootstrap_means,
    paired_difference,
    percentile_levels,
)


@dataclass(frozen=True)
class NormalizedScore:
    """Percent of the way from the random driver to MOBIL; without a value, the reason why there is none."""

    percent: float | None
    interval: list[float] | None
    reason: str | None


def no_score(reason: str) -> NormalizedScore:
    """A score that cannot be given."""
    return NormalizedScore(None, None, reason)


def normalized_percent(
    agent: npt.ArrayLike,
    mobil: npt.ArrayLike,
    random_legal: npt.ArrayLike,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> NormalizedScore:
    """Score of ``agent`` from returns [E] of the three drivers on the same episodes, in the same order.

    The interval resamples episodes, all three drivers together; resamples in which MOBIL's lead over the random
    driver is exactly 0 (a few identical episodes) have no score and are left out. There is no score at all where the
    paired interval of that lead includes 0: the scale would have no length.
    """
    returns = np.stack([np.asarray(values, dtype=np.float64) for values in (agent, mobil, random_legal)], axis=1)
    lead = paired_difference(returns[:, 1], returns[:, 2], resamples=resamples, seed=seed)
    if lead.interval is None:
        return no_score("fewer than two episodes")
    if not lead.excludes_zero():
        return no_score(
            f"the interval of mobil's lead over random_legal includes 0 ({lead.low:.1f} to {lead.high:.1f})"
        )
    means = bootstrap_means(returns, resamples, seed)
    low, high = np.quantile(_percent_of_way(means[means[:, 1] != means[:, 2]]), percentile_levels())
    return NormalizedScore(float(_percent_of_way(returns.mean(axis=0))), [float(low), float(high)], None)


def _percent_of_way(means: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """``100 (R - R_0) / (R_MOBIL - R_0)`` from means [..., 3] of agent, MOBIL and random driver."""
    return 100.0 * (means[..., 0] - means[..., 2]) / (means[..., 1] - means[..., 2])
