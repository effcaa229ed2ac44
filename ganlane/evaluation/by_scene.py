"""Crashes per km on recorded scenes, with intervals that know how few scenes there are.

Many episodes of one scene are not many observations: they start a tenth of a second apart, among the same drivers.
So whole scenes are resampled, and the ratio (all crashes over all kilometres) is taken anew in each resample.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from ganlane.errors import UserError
from ganlane.evaluation.counts import poisson_interval
from ganlane.evaluation.statistics import RESAMPLES, Array, Estimate, percentile_levels, resample_counts

#: The reason of an episode that is counted (column ``reason`` of :func:`ganlane.evaluation.run_episodes`).
_CRASH = "hard_crash"


@dataclass(frozen=True)
class CrashesByScene:
    """Hard crashes per km.

    Attributes:
        per_km: of all scenes together, with the 95 % interval of the bootstrap over scenes; no interval with fewer
            than two scenes. Where nobody crashed the upper bound is Poisson's exact one for the distance driven,
            since resampling zeros gives zero.
        rows: one per scene, by name: ``scene, episodes, hard_crash, distance_km, crashes_per_km`` (None where
            nothing was driven) and ``crashes_per_km_ci`` (exact, Poisson, as if its episodes were independent).
    """

    per_km: Estimate
    rows: list[dict[str, Any]]


def crashes_by_scene(
    episodes: pl.DataFrame, scenes: Sequence[str], resamples: int = RESAMPLES, seed: int = 0
) -> CrashesByScene:
    """Crashes per km, in all and by scene.

    Args:
        episodes: ``reason`` and ``distance_m`` per episode (:func:`ganlane.evaluation.run_episodes`), of one driver.
        scenes: the scene of each of them (:meth:`ganlane.traffic.ReplayTraffic.scenes_of_episodes`).
        resamples, seed: of the bootstrap.

    Raises:
        UserError: not one scene per episode, or nobody drove.
    """
    if len(scenes) != episodes.height:
        raise UserError(f"{len(scenes)} scenes for {episodes.height} episodes: expected one for each.")
    by_scene = (
        episodes.select("reason", "distance_m", pl.Series("scene", scenes, pl.String))
        .group_by("scene")
        .agg(
            pl.len().alias("episodes"),
            (pl.col("reason") == _CRASH).sum().alias(_CRASH),
            (pl.col("distance_m").cast(pl.Float64).sum() / 1000.0).alias("distance_km"),
        )
        .sort("scene")
    )
    crashes, km = (by_scene[name].to_numpy().astype(np.float64) for name in (_CRASH, "distance_km"))
    if not km.sum() > 0.0:
        raise UserError("crashes per km: nobody drove; give episodes that last at least one decision.")
    return CrashesByScene(_ratio(crashes, km, resamples, seed), [_row(row) for row in by_scene.to_dicts()])


def _row(scene: dict[str, Any]) -> dict[str, Any]:
    """A scene with its rate and exact interval."""
    events, km = poisson_interval(scene[_CRASH]), scene["distance_km"]
    if km <= 0.0:
        return {**scene, "crashes_per_km": None, "crashes_per_km_ci": None}
    interval = [bound / km for bound in events.interval or []]
    return {**scene, "crashes_per_km": events.value / km, "crashes_per_km_ci": interval}


def _ratio(crashes: Array, km: Array, resamples: int, seed: int) -> Estimate:
    """All ``crashes`` [S] over all ``km`` [S], with its percentile interval over resampled scenes."""
    value = float(crashes.sum() / km.sum())
    if len(km) < 2:
        return Estimate(value, None, None)
    if crashes.sum() == 0:
        return Estimate(value, 0.0, (poisson_interval(0).high or 0.0) / float(km.sum()))
    driven = km.clip(min=np.finfo(np.float64).tiny)
    ratios = [counts @ crashes / (counts @ driven) for counts in resample_counts(len(km), resamples, seed)]
    low, high = np.quantile(np.concatenate(ratios), percentile_levels())
    return Estimate(value, float(low), float(high))
