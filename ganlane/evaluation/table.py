"""The table of an evaluation: one row per agent and traffic, from one row per episode."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl

from ganlane import keys
from ganlane.evaluation.counts import clopper_pearson, rate_per_1000_km
from ganlane.evaluation.score import NormalizedScore, no_score, normalized_percent
from ganlane.evaluation.statistics import mean_interval, paired_difference

#: The two drivers that give the normalised score its scale.
SCALE_TOP = "mobil"
SCALE_BOTTOM = "random_legal"
_EPISODE = ["seed", "episode"]

Row = dict[str, Any]


def evaluation_rows(episodes: pl.DataFrame) -> list[Row]:
    """Rows of the ``evaluate`` command, in the order in which agents and traffics first appear.

    Args:
        episodes: what :func:`ganlane.evaluation.run_episodes` returns, with ``agent`` and ``traffic`` added,
            for every pair, one below the other.

    Returns:
        Per pair ``agent, traffic, episodes``; the counts ``goal, hard_crash, out_of_road, timeout,
        scene_end`` (how episodes ended) and ``soft_crash`` (episodes with at least one),
        ``soft_crash_onsets``, ``soft_crash_behind_onsets``; ``mean_reward`` and ``reward_sd``;
        ``mean_speed_mps`` (distance over time of all episodes together); ``lane_changes_per_km``;
        ``distance_km``; ``hard_crash_share``; ``crashes_per_1000_km`` (hard crashes);
        ``minus_mobil`` (paired difference of the mean reward to MOBIL's on the same episodes);
        ``normalized_percent``, with ``normalized_percent_reason`` where it is None. A key with ``_ci``
        holds the 95 % interval of its namesake as ``[low, high]``, or None.
    """
    pairs = episodes.partition_by(["agent", "traffic"], maintain_order=True)
    return [_row(pair, episodes) for pair in pairs]


def _row(pair: pl.DataFrame, episodes: pl.DataFrame) -> Row:
    """The row of one agent on one traffic; ``episodes`` holds those of the drivers that give the scale."""
    agent, traffic = pair["agent"][0], pair["traffic"][0]
    row: Row = {"agent": agent, "traffic": traffic, "episodes": pair.height}
    row |= _outcomes(pair) | _returns(pair) | _driving(pair)
    same_traffic = episodes.filter(pl.col("traffic") == traffic)
    return row | _lead(pair, same_traffic) | _score_fields(_score(pair, same_traffic))


def _outcomes(pair: pl.DataFrame) -> Row:
    """How the episodes ended, and soft crashes on the way."""
    ended = {reason: int((pair["reason"] == reason).sum()) for reason in keys.END_EVENTS}
    return {
        "goal": ended["goal"],
        "hard_crash": ended["hard_crash"],
        "soft_crash": int(pair["had_soft_crash"].sum()),
        "out_of_road": ended["out_of_road"],
        "timeout": ended["timeout"],
        "scene_end": ended["scene_end"],
        "soft_crash_onsets": int(pair["soft_crash"].sum()),
        "soft_crash_behind_onsets": int(pair["soft_crash_behind"].sum()),
    }


def _returns(pair: pl.DataFrame) -> Row:
    """Mean return with its interval, and the returns' standard deviation as the paper gives it."""
    returns = pair["reward"].to_numpy()
    mean = mean_interval(returns)
    spread = float(np.std(returns, ddof=1)) if len(returns) > 1 else None
    return {"mean_reward": mean.value, "mean_reward_ci": mean.interval, "reward_sd": spread}


def _driving(pair: pl.DataFrame) -> Row:
    """Speed, lane changes and crashes, related to the time and the distance of all episodes together."""
    distance_m, duration_s = float(pair["distance_m"].sum()), float(pair["duration_s"].sum())
    crashes = int((pair["reason"] == "hard_crash").sum())
    share, rate = clopper_pearson(crashes, pair.height), rate_per_1000_km(crashes, distance_m)
    changes = int(pair["lane_changes"].sum())
    return {
        "mean_speed_mps": distance_m / duration_s if duration_s > 0 else None,
        "lane_changes_per_km": changes / distance_m * 1000.0 if distance_m > 0 else None,
        "distance_km": distance_m / 1000.0,
        "hard_crash_share": share.value,
        "hard_crash_share_ci": share.interval,
        "crashes_per_1000_km": None if rate is None else rate.value,
        "crashes_per_1000_km_ci": None if rate is None else rate.interval,
    }


def _lead(pair: pl.DataFrame, same_traffic: pl.DataFrame) -> Row:
    """What the agent earns more than MOBIL on the episodes that both drove; None for MOBIL itself or without it."""
    mobil = same_traffic.filter(pl.col("agent") == SCALE_TOP)
    if pair["agent"][0] == SCALE_TOP or mobil.height == 0:
        return {"minus_mobil": None, "minus_mobil_ci": None}
    both = pair.select([*_EPISODE, "reward"]).join(_named(mobil, SCALE_TOP), on=_EPISODE).sort(_EPISODE)
    if both.height < 2:
        return {"minus_mobil": None, "minus_mobil_ci": None}
    lead = paired_difference(_column(both, "reward"), _column(both, SCALE_TOP))
    return {"minus_mobil": lead.value, "minus_mobil_ci": lead.interval}


def _named(driver: pl.DataFrame, name: str) -> pl.DataFrame:
    """Episodes and rewards of ``driver``, the rewards under its ``name``."""
    return driver.select([*_EPISODE, pl.col("reward").alias(name)])


def _score_fields(score: NormalizedScore) -> Row:
    """The columns of the normalised score."""
    return {
        "normalized_percent": score.percent,
        "normalized_percent_ci": score.interval,
        "normalized_percent_reason": score.reason,
    }


def _score(pair: pl.DataFrame, same_traffic: pl.DataFrame) -> NormalizedScore:
    """The normalised score of one agent, from the episodes that it shares with the two drivers of the scale."""
    returns = [pair.select([*_EPISODE, "reward"])]
    for name in (SCALE_TOP, SCALE_BOTTOM):
        driver = same_traffic.filter(pl.col("agent") == name)
        if driver.height == 0:
            return no_score(f"needs {SCALE_TOP} and {SCALE_BOTTOM} among the agents; {name} is missing")
        returns.append(_named(driver, name))
    paired = returns[0].join(returns[1], on=_EPISODE).join(returns[2], on=_EPISODE).sort(_EPISODE)
    if paired.height < 2:
        return no_score("fewer than two episodes are shared by the drivers")
    agent, mobil, random_legal = (_column(paired, name) for name in ("reward", SCALE_TOP, SCALE_BOTTOM))
    return normalized_percent(agent, mobil, random_legal)


def _column(frame: pl.DataFrame, name: str) -> npt.NDArray[np.float64]:
    """A column as float64."""
    return frame[name].cast(pl.Float64).to_numpy()
