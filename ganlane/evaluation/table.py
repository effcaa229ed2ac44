"""The table of an evaluation: one row per agent and traffic, from one row per episode."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl

from ganlane import keys
from ganlane.evaluation.counts import clopper_pearson, rate_per_1000_km
from ganlane.evaluation.paired import paired_lead, paired_rewards
from ganlane.evaluation.score import NormalizedScore, no_score, normalized_percent
from ganlane.evaluation.statistics import mean_interval

#: The two drivers that give the normalised score its scale.
SCALE_TOP = "mobil"
SCALE_BOTTOM = "random_legal"

Row = dict[str, Any]


def evaluation_rows(episodes: pl.DataFrame) -> list[Row]:
    """Rows of the ``evaluate`` command, in the order in which agents and traffics first appear.

    Args:
        episodes: what :func:`ganlane.evaluation.run_episodes` returns, with ``agent`` and ``traffic`` added,
            for every pair, one below the other.

    Returns:
        Per pair ``agent, traffic, episodes``; the counts ``goal, hard_crash, out_of_road, timeout,
        scene_end`` (how episodes ended) and ``soft_crash`` (episodes with at least one),
        ``soft_crash_onsets``, ``soft_crash_behind_onsets`` and the latter's mean ``soft_crash_behind_per_episode``;
        ``mean_reward`` and ``reward_sd``;
        ``mean_speed_mps`` (distance over time of all episodes together); ``lane_changes_per_km``;
        ``distance_km``; ``hard_crash_share`` and ``out_of_road_share`` of the episodes (exact intervals);
        ``crashes_per_1000_km`` (hard crashes);
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
        **_mean_fields("soft_crash_behind_per_episode", pair["soft_crash_behind"].to_numpy()),
    }


def _mean_fields(key: str, values: npt.ArrayLike) -> Row:
    """Mean of one value per episode, with its bootstrap interval."""
    mean = mean_interval(values)
    return {key: mean.value, f"{key}_ci": mean.interval}


def _returns(pair: pl.DataFrame) -> Row:
    """Mean return with its interval, and the returns' standard deviation as the paper gives it."""
    returns = pair["reward"].to_numpy()
    spread = float(np.std(returns, ddof=1)) if len(returns) > 1 else None
    return {**_mean_fields("mean_reward", returns), "reward_sd": spread}


def _driving(pair: pl.DataFrame) -> Row:
    """Speed, lane changes and crashes, related to the time and the distance of all episodes together."""
    distance_m, duration_s = float(pair["distance_m"].sum()), float(pair["duration_s"].sum())
    crashes = int((pair["reason"] == "hard_crash").sum())
    share, rate = clopper_pearson(crashes, pair.height), rate_per_1000_km(crashes, distance_m)
    off_road = clopper_pearson(int((pair["reason"] == "out_of_road").sum()), pair.height)
    changes = int(pair["lane_changes"].sum())
    return {
        "mean_speed_mps": distance_m / duration_s if duration_s > 0 else None,
        "lane_changes_per_km": changes / distance_m * 1000.0 if distance_m > 0 else None,
        "distance_km": distance_m / 1000.0,
        "hard_crash_share": share.value,
        "hard_crash_share_ci": share.interval,
        "out_of_road_share": off_road.value,
        "out_of_road_share_ci": off_road.interval,
        "crashes_per_1000_km": None if rate is None else rate.value,
        "crashes_per_1000_km_ci": None if rate is None else rate.interval,
    }


def _lead(pair: pl.DataFrame, same_traffic: pl.DataFrame) -> Row:
    """What the agent earns more than MOBIL on the episodes that both drove; None for MOBIL itself or without it."""
    mobil = same_traffic.filter(pl.col("agent") == SCALE_TOP)
    if pair["agent"][0] == SCALE_TOP or mobil.height == 0:
        return {"minus_mobil": None, "minus_mobil_ci": None}
    lead, _ = paired_lead(pair, mobil)
    return {"minus_mobil": lead.value if lead else None, "minus_mobil_ci": lead.interval if lead else None}


def _score_fields(score: NormalizedScore) -> Row:
    """The columns of the normalised score."""
    return {
        "normalized_percent": score.percent,
        "normalized_percent_ci": score.interval,
        "normalized_percent_reason": score.reason,
    }


def _score(pair: pl.DataFrame, same_traffic: pl.DataFrame) -> NormalizedScore:
    """The normalised score of one agent, from the episodes that it shares with the two drivers of the scale."""
    drivers = [pair]
    for name in (SCALE_TOP, SCALE_BOTTOM):
        driver = same_traffic.filter(pl.col("agent") == name)
        if driver.height == 0:
            return no_score(f"needs {SCALE_TOP} and {SCALE_BOTTOM} among the agents; {name} is missing")
        drivers.append(driver)
    agent, mobil, random_legal = paired_rewards(*drivers)
    if len(agent) < 2:
        return no_score("fewer than two episodes are shared by the drivers")
    return normalized_percent(agent, mobil, random_legal)
