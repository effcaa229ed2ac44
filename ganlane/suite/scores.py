"""The numbers of a benchmark with the training as the unit: by traffic, over traffics, by pair."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl

from ganlane.agents.checkpoint import SHIPPED
from ganlane.errors import UserError
from ganlane.evaluation.measures import CRASHES
from ganlane.evaluation.rows import (
    FAILURES,
    SCALE_BOTTOM,
    SCALE_TOP,
    counts_of_ends,
    speed_and_lane_changes,
)
from ganlane.evaluation.statistics import (
    Array,
    Estimate,
    clopper_pearson,
    difference,
    entries,
    improvement_over_traffics,
    interquartile_mean,
    mcnemar,
    over_trainings,
    rate_over_trainings,
    score_over_traffics,
)
from ganlane.settings.suite import Suite

#: Numbers by name, as they stand in ``results.json``.
Row = dict[str, Any]
#: Recipe and traffic to the episodes of each training, by driver's name.
Cells = Mapping[tuple[str, str], Mapping[str, pl.DataFrame]]
#: A smaller time to collision is a near miss, s (van der Horst 1990).
NEAR_MISS_S = 1.5
#: How an episode ends without a failure.
ENDS = ("goal", "missed_exit", "timeout")
_CRASH, _DEPARTURE = FAILURES
_REASON = pl.col("reason")
#: Rates per 1000 km by name: the episodes that they count.
_RATES = {
    "crashes": _REASON == _CRASH,
    "departures": _REASON == _DEPARTURE,
    "failures": _REASON.is_in(FAILURES),
    # Null where nobody crashed.
    "at_fault": pl.col("at_fault").fill_null(False),
    # A crash is more than a near miss.
    "near_misses": (pl.col("least_ttc_s") < NEAR_MISS_S) & (_REASON != _CRASH),
}


def recipe_of(driver: str) -> str:
    """``agent_idm+safe`` of ``agent_idm@3+safe`` and of ``FOLDER/agent_idm.safetensors@3+safe``.

    A driver without a seed is a recipe of its own.
    """
    # Name, seed and mask: a folder and the file's ending do not belong to the recipe.
    packed = re.fullmatch(r"(?:.*/)?(.+?)(?:\.safetensors)?@\d+(\+.*)?", driver)
    if packed is None:
        return driver
    return packed[1] + (packed[2] or "")


def seed_of(driver: str) -> int:
    """3 of ``agent_idm@3+safe``; that of a shipped agent where none is named, otherwise 0."""
    named = re.search(r"@(\d+)(?:\+|$)", driver)
    if named:
        return int(named[1])

    # Without its mask: it is the same training behind another one.
    name, _, _ = driver.partition("+")
    return SHIPPED.get(name, 0)


def by_recipe(episodes: pl.DataFrame) -> dict[tuple[str, str], dict[str, pl.DataFrame]]:
    """The episodes of the matrix by recipe and traffic, in the order in which they first appear.

    Args:
        episodes: of :func:`ganlane.suite.driving.drive_suite`.

    Returns:
        By recipe and traffic, by driver's name the episodes of each training, sorted by number.

    Raises:
        UserError: two trainings of one recipe have the same seed.
    """
    cells: dict[tuple[str, str], dict[str, pl.DataFrame]] = {}
    for (driver, traffic), frame in episodes.group_by("agent", "traffic", maintain_order=True):
        recipe = recipe_of(str(driver))
        trainings = cells.setdefault((recipe, str(traffic)), {})
        trainings[str(driver)] = frame.sort("episode")

        # The same training twice would count as two.
        if len(set(map(seed_of, trainings))) < len(trainings):
            names = ", ".join(trainings)
            raise UserError(
                f"agents: two of one seed are called {recipe} ({names}); leave one out."
            )
    return cells


def column(trainings: Mapping[str, pl.DataFrame], value: str | pl.Expr) -> Array:
    """A column of each training as a table [S, E], as doubles.

    Replayed episodes of one recorded car are near copies of each other: their mean is one entry.

    Args:
        trainings: S trainings of a recipe on one traffic, by driver's name, of E episodes each.
        value: the column's name, or what is computed of the columns.
    """
    columns = []
    for frame in trainings.values():
        chosen = frame.select(value=value).cast(pl.Float64)
        # Other traffics than replayed ones have no car, or nulls where one of the suite replays.
        if "car" in frame.columns and frame["car"].null_count() == 0:
            chosen = chosen.group_by(frame["car"], maintain_order=True).mean()
        columns.append(chosen["value"].to_numpy())
    return np.stack(columns)


def rows(cells: Cells) -> list[Row]:
    """One row per recipe and traffic.

    Args:
        cells: of :func:`by_recipe`; MOBIL drove on every traffic.

    Returns:
        Per row ``driver, traffic, trainings`` S, ``episodes`` E of each; ``mean_reward``,
        ``interquartile_mean`` (of the trainings' mean rewards) and ``reward_sd`` (over all
        episodes); ``minus_mobil`` and ``probability_above_mobil`` (None for MOBIL, the latter for a
        single training, too); ``normalized_percent``; ``hard_crash``, ``soft_crash`` (episodes with
        one) and ``out_of_road`` of all trainings together, and so ``goal``, ``missed_exit`` and
        ``timeout``; ``goal_s``, the mean time until the goal where it was reached;
        ``hard_crash_share`` (exact interval of all episodes, as if they were independent);
        ``crashes``, ``departures`` and ``failures`` (both), ``at_fault`` (the ego moved into the
        other) and ``near_misses`` (episodes without a crash, with a time to collision below
        :data:`NEAR_MISS_S`) ``_per_1000_km``; ``mean_speed_mps, lane_changes_per_km,
        soft_crash_behind_per_episode``; ``at_fault_share`` of the hard crashes (None without any)
        and ``crash_kinds``, how many of each of :data:`ganlane.evaluation.measures.CRASHES`;
        ``least_ttc_s`` and ``least_headway_s`` (median of the episodes' smallest),
        ``rms_acceleration_mps2`` and ``hardest_braking_mps2`` (means of the episodes'); and
        ``each``, mean reward, lead over MOBIL and failures of every training. A key with ``_ci``
        holds the 95 % interval of its namesake over trainings and episodes.
    """
    return [_row(recipe, traffic, cells) for recipe, traffic in cells]


def _row(recipe: str, traffic: str, cells: Cells) -> Row:
    """One of :func:`rows`."""
    # Rewards are [S, E]: trainings by episodes, the same episodes for all drivers.
    trainings = cells[recipe, traffic]
    rewards = column(trainings, "reward")

    # MOBIL drives on every traffic; it is not compared with itself.
    mobil = column(cells[SCALE_TOP, traffic], "reward")
    is_mobil = recipe == SCALE_TOP
    lead = None if is_mobil else difference(rewards, mobil)
    above_mobil = None if is_mobil else _probability(rewards, mobil)

    # What cannot be said stays None and is printed as a dash.
    score = None
    if (SCALE_BOTTOM, traffic) in cells:
        random_legal = column(cells[SCALE_BOTTOM, traffic], "reward")
        # Without a lead of MOBIL over the random driver the scale would have no length.
        if difference(mobil, random_legal).excludes_zero():
            score = score_over_traffics([(rewards, mobil, random_legal)])

    # Counts and plain rates are of the episodes of all trainings.
    together = pl.concat(trainings.values())
    row: Row = {
        "driver": recipe,
        "traffic": traffic,
        "trainings": len(rewards),
        "episodes": together.height // len(trainings),
        **entries("mean_reward", over_trainings(rewards)),
        **entries("interquartile_mean", over_trainings(rewards, interquartile_mean)),
        "reward_sd": float(together["reward"].to_numpy().std(ddof=1)),
        **entries("minus_mobil", lead),
        **entries("probability_above_mobil", above_mobil),
        **entries("normalized_percent", score),
        **safety(trainings),
    }

    # Trainings one by one, so that a reader sees how far they lie apart.
    row["each"] = []
    # Rewards as tables [1, E].
    for (name, frame), alone in zip(trainings.items(), rewards[:, None]):
        training = {
            "driver": name,
            **entries("mean_reward", over_trainings(alone)),
            **entries("minus_mobil", None if is_mobil else difference(alone, mobil)),
            **counts_of_ends(frame, FAILURES),
        }
        row["each"].append(training)
    return row


def safety(trainings: Mapping[str, pl.DataFrame]) -> Row:
    """What :func:`rows` says of crashes, near misses, comfort and speed.

    ``trainings`` of one recipe by driver's name, on one traffic or on several together.
    """
    # All trainings together, in which an episode counts once for each of them.
    together = pl.concat(trainings.values())
    at_goal = together.filter(_REASON == "goal")
    crashes = together.filter(_RATES["crashes"])
    kinds = {kind: int((crashes["crash"] == kind).sum()) for kind in CRASHES}
    crash_share = clopper_pearson(crashes.height, together.height)

    row: Row = {
        **counts_of_ends(together, (*FAILURES, *ENDS)),
        "goal_s": at_goal["duration_s"].mean(),
        "soft_crash": int(together["had_soft_crash"].sum()),
        **entries("hard_crash_share", crash_share),
        "at_fault_share": crashes["at_fault"].mean(),
        "crash_kinds": kinds,
        "least_ttc_s": together["least_ttc_s"].median(),
        "least_headway_s": together["least_headway_s"].median(),
        "rms_acceleration_mps2": together["rms_acceleration_mps2"].mean(),
        "hardest_braking_mps2": together["hardest_braking_mps2"].mean(),
        **speed_and_lane_changes(together),
        "soft_crash_behind_per_episode": together["soft_crash_behind"].mean(),
    }

    # Rates have intervals over trainings and episodes, so they need the tables [S, E].
    km = column(trainings, pl.col("distance_m") / 1000.0)
    for name, counted in _RATES.items():
        rate = rate_over_trainings(column(trainings, counted), km)
        row |= entries(f"{name}_per_1000_km", None if rate is None else rate.scaled(1000.0))
    return row


def summaries(cells: Cells, matrix: Sequence[Row], suite: Suite) -> list[Row]:
    """One row per recipe, over the traffics of the score.

    Args:
        cells: of :func:`by_recipe`.
        matrix: their :func:`rows`.
        suite: its traffics of the score.

    Returns:
        Per row ``entry, trainings``; ``score``, the interquartile mean over traffics of the
        normalised scores; ``by_traffic``, those scores with their intervals; ``worst`` and
        ``worst_traffic``, the lowest of them; ``improvement``, by name of each driver of the suite
        how likely a training is above it on a traffic; and what :func:`rows` says of safety, of
        all these traffics together.
    """
    scored = list(suite.scored)
    recipes = dict.fromkeys(recipe for recipe, _ in cells)

    names = ("normalized_percent", "normalized_percent_ci")

    # By recipe, a table [S, E] for every traffic of the score.
    rewards = {}
    for recipe in recipes:
        rewards[recipe] = [column(cells[recipe, traffic], "reward") for traffic in scored]
    mobil = rewards[SCALE_TOP]
    random_legal = rewards[SCALE_BOTTOM]

    summary = []
    for recipe, ours in rewards.items():
        # The scores by traffic are those of the matrix, also on traffics that do not count.
        scores = {}
        for row in matrix:
            if row["driver"] == recipe:
                scores[row["traffic"]] = {name: row[name] for name in names}

        # The lowest score among those that are decided; None where MOBIL has no lead anywhere.
        decided = {}
        for traffic in scored:
            percent = scores[traffic]["normalized_percent"]
            if percent is not None:
                decided[traffic] = percent
        worst = min(decided, key=lambda traffic: decided[traffic], default=None)

        # A suite's driver is not compared with itself.
        improvement = {}
        for other in suite.drivers():
            if other != recipe:
                pairs = list(zip(ours, rewards[other]))
                improvement[other] = entries("probability", improvement_over_traffics(pairs))

        # The episodes of every training on all traffics of the score.
        together = {}
        for name in cells[recipe, scored[0]]:
            together[name] = pl.concat([cells[recipe, traffic][name] for traffic in scored])

        score = score_over_traffics(list(zip(ours, mobil, random_legal)))
        summary.append(
            {
                "entry": recipe,
                "trainings": len(together),
                **entries("score", score),
                "by_traffic": scores,
                "worst": None if worst is None else decided[worst],
                "worst_traffic": worst,
                "improvement": improvement,
                **safety(together),
            }
        )
    return summary


def comparisons(cells: Cells, pairs: Sequence[tuple[str, str]]) -> list[Row]:
    """Recipes compared on every traffic that both drove on.

    Args:
        cells: of :func:`by_recipe`.
        pairs: recipes, first and second.

    Returns:
        Per pair and traffic ``driver, over, traffic, lead`` (difference of mean rewards),
        ``probability`` (that a training of the first is above one of the second),
        ``crash_difference_per_1000_episodes``, and ``mcnemar``: for each training of the first that
        has a namesake of the second (same seed, or the only one) the episodes in which one alone
        crashed, and the exact probability.
    """
    compared = []
    for one, other in pairs:
        for recipe, traffic in cells:
            # Somebody may not have driven on a traffic, or nowhere.
            if recipe != one or (other, traffic) not in cells:
                continue

            compared.append(
                {
                    "driver": one,
                    "over": other,
                    "traffic": traffic,
                    **_compared(cells[one, traffic], cells[other, traffic]),
                }
            )
    return compared


def _compared(first: Mapping[str, pl.DataFrame], second: Mapping[str, pl.DataFrame]) -> Row:
    """The numbers of a row of :func:`comparisons`."""
    # Tables [S, E] and [S', E] of both.
    rewards = [column(cell, "reward") for cell in (first, second)]
    crashed, other_crashed = (column(cell, _RATES["crashes"]) for cell in (first, second))

    # Per 1000 episodes, which is easier to read than a share.
    more_crashes = _crash_difference(crashed, other_crashed).scaled(1000.0)

    # Trainings of one seed started from the same random numbers.
    namesakes = dict(zip(map(seed_of, second), other_crashed))
    # A driver without trainings, say MOBIL, is held against every training of the first.
    if len(namesakes) == 1:
        namesakes = dict.fromkeys(map(seed_of, first), other_crashed[0])

    tests = []
    for name, crashes in zip(first, crashed):
        seed = seed_of(name)
        if seed in namesakes:
            # A recorded car counts as crashed where any of its episodes did.
            test = mcnemar(crashes > 0, namesakes[seed] > 0)
            tests.append({"driver": name, **vars(test)})

    return {
        **entries("lead", difference(*rewards)),
        **entries("probability", _probability(*rewards)),
        **entries("crash_difference_per_1000_episodes", more_crashes),
        "mcnemar": tests,
    }


def _crash_difference(first: Array, second: Array) -> Estimate:
    """Difference of the shares of episodes with a crash.

    Args:
        first: 1 for a crash, [S, E].
        second: the same on the same episodes, [S', E].
    """
    if first.any() or second.any():
        return difference(first, second)

    # Nobody crashed, and resampling would leave no doubt. That is no proof that nobody would crash,
    # so the interval is the exact bound of no crash in E episodes, to both sides.
    most = clopper_pearson(0, first.shape[1]).high or 0.0
    return Estimate(0.0, -most, most)


def _probability(first: Array, second: Array) -> Estimate | None:
    """How likely a training of the first, [S, E], is above one of the second, [S', E].

    None where neither has a second training: it says nothing then.
    """
    if len(first) + len(second) == 2:
        return None
    return improvement_over_traffics([(first, second)])
