"""Results of the matrix: a row for each recipe on each traffic, and comparisons of drivers."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl

from ganlane.errors import UserError
from ganlane.evaluation.rows import FAILURES, SCALE_BOTTOM, SCALE_TOP
from ganlane.evaluation.statistics import (
    Array,
    Estimate,
    clopper_pearson,
    difference,
    entries,
    interquartile_mean,
    mcnemar,
    normalized_over_trainings,
    over_trainings,
    probability_of_improvement,
    rate_over_trainings,
)

Row = dict[str, Any]
#: Recipe and traffic to the episodes of each training, by driver's name.
Cells = Mapping[tuple[str, str], Mapping[str, pl.DataFrame]]
#: Rates per 1000 km by name: the ends that they count.
_RATES = {"crashes": FAILURES[:1], "departures": FAILURES[1:], "failures": FAILURES}


def recipe_of(driver: str) -> str:
    """``agent_idm+safe`` of ``agent_idm@3+safe`` and of ``FOLDER/agent_idm.safetensors@3+safe``."""
    packed = re.fullmatch(r"(?:.*/)?(.+?)(?:\.safetensors)?@\d+(\+.*)?", driver)
    return driver if packed is None else packed[1] + (packed[2] or "")


def seed_of(driver: str) -> int:
    """3 of ``agent_idm@3+safe``; 0 where no seed is named: ``agent_idm`` is ``agent_idm@0``."""
    named = re.search(r"@(\d+)(?:\+|$)", driver)
    return int(named[1]) if named else 0


def by_recipe(episodes: pl.DataFrame) -> dict[tuple[str, str], dict[str, pl.DataFrame]]:
    """The episodes of the matrix by recipe and traffic, in the order in which they first appear."""
    cells: dict[tuple[str, str], dict[str, pl.DataFrame]] = {}
    for (driver, traffic), frame in episodes.group_by("agent", "traffic", maintain_order=True):
        recipe = recipe_of(str(driver))
        there = cells.setdefault((recipe, str(traffic)), {})
        there[str(driver)] = frame.sort("episode")
        if len({seed_of(name) for name in there}) < len(there):
            raise UserError(f"agents: two of one seed are called {recipe} ({', '.join(there)}); leave one out.")
    return cells


def column(trainings: Mapping[str, pl.DataFrame], value: str | pl.Expr) -> Array:
    """A column of each training as a table [S, E]."""
    return np.stack([frame.select(value).to_series().cast(pl.Float64).to_numpy() for frame in trainings.values()])


def _ended(reasons: Sequence[str]) -> pl.Expr:
    return pl.col("reason").is_in(list(reasons))


def rows(cells: Cells) -> list[Row]:
    """One row per recipe and traffic.

    Returns:
        Per row ``driver, traffic, trainings`` S, ``episodes`` E of each; ``mean_reward``, ``interquartile_mean`` (of
        the trainings' mean rewards) and ``reward_sd`` (over all episodes); ``minus_mobil`` and
        ``probability_above_mobil`` (None for MOBIL, the latter for a single training, too); ``normalized_percent``;
        ``hard_crash``, ``soft_crash`` (episodes with one) and ``out_of_road`` of all trainings together;
        ``hard_crash_share`` (exact interval of all episodes, as if they were independent); ``crashes``,
        ``departures`` and ``failures`` (both) ``_per_1000_km``; ``mean_speed_mps, lane_changes_per_km,
        soft_crash_behind_per_episode``; ``at_fault_share`` of the hard crashes (None without any); and ``each``, mean
        reward, lead over MOBIL and failures of every training. A key with ``_ci`` holds the 95 % interval of its
        namesake over trainings and episodes.
    """
    return [_row(recipe, traffic, trainings, cells) for (recipe, traffic), trainings in cells.items()]


def _row(recipe: str, traffic: str, trainings: Mapping[str, pl.DataFrame], cells: Cells) -> Row:
    rewards, km = column(trainings, "reward"), column(trainings, pl.col("distance_m") / 1000.0)
    mobil, random_legal = (cells.get((name, traffic)) for name in (SCALE_TOP, SCALE_BOTTOM))
    above = None if mobil is None or recipe == SCALE_TOP else column(mobil, "reward")
    together = pl.concat(trainings.values())
    crashes = together.filter(_ended(FAILURES[:1]))
    seconds, driven = float(together["duration_s"].sum()), float(km.sum())
    score = None
    if mobil is not None and random_legal is not None:
        score = normalized_over_trainings(rewards, column(mobil, "reward"), column(random_legal, "reward"))
    row: Row = {"driver": recipe, "traffic": traffic, "trainings": len(rewards), "episodes": rewards.shape[1]}
    row |= entries("mean_reward", over_trainings(rewards))
    row |= entries("interquartile_mean", over_trainings(rewards, interquartile_mean))
    row["reward_sd"] = float(rewards.std(ddof=1))
    row |= entries("minus_mobil", None if above is None else difference(rewards, above))
    row |= entries("probability_above_mobil", None if above is None else _probability(rewards, above))
    row |= entries("normalized_percent", score)
    row |= {end: together.filter(_ended([end])).height for end in FAILURES}
    row["soft_crash"] = int(together["had_soft_crash"].sum())
    row |= entries("hard_crash_share", clopper_pearson(crashes.height, together.height))
    for name, ends in _RATES.items():
        rate = rate_over_trainings(column(trainings, _ended(ends)), km)
        row |= entries(f"{name}_per_1000_km", None if rate is None else rate.scaled(1000.0))
    row["mean_speed_mps"] = 1000.0 * driven / seconds if seconds > 0.0 else None
    row["lane_changes_per_km"] = int(together["lane_changes"].sum()) / driven if driven > 0.0 else None
    row["soft_crash_behind_per_episode"] = together["soft_crash_behind"].mean()
    row["at_fault_share"] = crashes["at_fault"].mean() if "at_fault" in crashes.columns else None
    row["each"] = []
    for (name, frame), own in zip(trainings.items(), rewards[:, None]):
        counts = {end: frame.filter(_ended([end])).height for end in FAILURES}
        lead = entries("minus_mobil", None if above is None else difference(own, above))
        row["each"].append({"driver": name, **entries("mean_reward", over_trainings(own)), **lead, **counts})
    return row


def comparisons(cells: Cells, pairs: Sequence[tuple[str, str]]) -> list[Row]:
    """Recipes compared on every traffic that both drove on.

    Returns:
        Per pair and traffic ``driver, over, traffic, lead`` (difference of mean rewards), ``probability`` (that a
        training of the first is above one of the second), ``crash_difference_per_1000_episodes``, and ``mcnemar``:
        for each training of the first that has a namesake of the second (same seed, or the only one) the episodes
        in which one alone crashed, and the exact probability.
    """
    found = []
    traffics = dict.fromkeys(traffic for _, traffic in cells)
    for one, other in pairs:
        for traffic in traffics:
            first, second = cells.get((one, traffic)), cells.get((other, traffic))
            if first is None or second is None:
                continue
            a, b = column(first, "reward"), column(second, "reward")
            hit, struck = (column(each, _ended(FAILURES[:1])) for each in (first, second))
            row: Row = {"driver": one, "over": other, "traffic": traffic}
            row |= entries("lead", difference(a, b)) | entries("probability", _probability(a, b))
            row |= entries("crash_difference_per_1000_episodes", _crash_difference(hit, struck).scaled(1000.0))
            theirs = {seed_of(name): crashed > 0 for name, crashed in zip(second, struck)}
            if len(theirs) == 1:
                theirs = dict.fromkeys(map(seed_of, first), struck[0] > 0)
            row["mcnemar"] = [
                {"driver": name, **vars(mcnemar(crashed > 0, theirs[seed_of(name)]))}
                for name, crashed in zip(first, hit)
                if seed_of(name) in theirs
            ]
            found.append(row)
    return found


def _crash_difference(first: Array, second: Array) -> Estimate:
    """Difference of the shares of episodes with a crash. Where there is none, resampling would leave no doubt."""
    if first.any() or second.any():
        return difference(first, second)
    most = clopper_pearson(0, first.shape[1]).high or 0.0
    return Estimate(0.0, -most, most)


def _probability(first: Array, second: Array) -> Estimate | None:
    """None where neither has a second training: it says nothing then."""
    return probability_of_improvement(first, second) if len(first) + len(second) > 2 else None
