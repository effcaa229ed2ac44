"""The numbers of an evaluation, from one row per episode.

By driver and traffic, by pair of drivers, by scene.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl

from ganlane import keys
from ganlane.errors import UserError
from ganlane.evaluation.statistics import (
    RESAMPLES,
    TAIL_LEVELS,
    Array,
    Estimate,
    bootstrap_means,
    clopper_pearson,
    entries,
    mean_interval,
    paired_difference,
    percent_of_way,
    poisson_interval,
    resample_counts,
    sign_flip_p,
)

#: The two drivers that give the normalised score its scale.
SCALE_TOP = "mobil"
SCALE_BOTTOM = "random_legal"
#: What two drivers' episodes are matched by.
_EPISODE = ["seed", "episode"]
_CRASH = "hard_crash"
#: The ends of an episode that are the driver's failures.
FAILURES = (_CRASH, "out_of_road")
#: Below so many shared episodes there is no verdict.
FEWEST_EPISODES = 30
#: A verdict may not hang on fewer failures than this.
FEWEST_FAILURES = 5
#: A verdict needs a sign-flip test of at most this probability.
_SIGNIFICANT = 0.05
_RETURN = pl.col("reward")

#: Numbers by name, as they stand in ``results.json``.
Row = dict[str, Any]


def evaluation_rows(episodes: pl.DataFrame) -> list[Row]:
    """Rows of the ``evaluate`` command, in the order in which agents and traffics first appear.

    ``episodes`` are what :func:`ganlane.evaluation.run_episodes` returns, with ``agent`` and
    ``traffic`` added, for every pair, one below the other.

    Returns:
        Per pair ``agent, traffic, episodes``; the counts ``goal, hard_crash, out_of_road,
        missed_exit, timeout, scene_end`` (how episodes ended) and ``soft_crash`` (episodes with at
        least one), ``soft_crash_onsets``, ``soft_crash_behind_onsets`` and the latter's mean
        ``soft_crash_behind_per_episode``; ``mean_reward`` and ``reward_sd``;
        ``mean_speed_mps`` (distance over time of all episodes together); ``lane_changes_per_km``;
        ``distance_km``; ``hard_crash_share`` and ``out_of_road_share`` of the episodes (exact
        intervals); ``crashes_per_1000_km`` (hard crashes);
        ``minus_mobil`` (paired difference of the mean reward to MOBIL's on the same episodes);
        ``normalized_percent``, with ``normalized_percent_reason`` where it is None. A key with
        ``_ci`` holds the 95 % interval of its namesake as ``[low, high]``, or None.
    """
    # Partitions keep the order of the command line.
    rows = []
    for pair in episodes.partition_by(["agent", "traffic"], maintain_order=True):
        same_traffic = episodes.filter(pl.col("traffic") == pair["traffic"][0])
        rows.append(_row(pair, same_traffic))
    return rows


def _row(pair: pl.DataFrame, same_traffic: pl.DataFrame) -> Row:
    """The row of one agent on one traffic.

    ``same_traffic`` also holds the drivers that give the scale.
    """
    returns = pair["reward"].to_numpy()
    # Every end has its column, also one that never happened.
    ended = counts_of_ends(pair, keys.END_EVENTS)
    crash_share = clopper_pearson(ended["hard_crash"], pair.height)
    departure_share = clopper_pearson(ended["out_of_road"], pair.height)

    # Per 1000 km, from m.
    distance_m = float(pair["distance_m"].sum())
    crashes = None
    if distance_m > 0.0:
        crashes = poisson_interval(ended[_CRASH]).scaled(1e6 / distance_m)

    # MOBIL has no lead over itself, and without it nobody has one.
    lead = None
    returns_of_both = _paired(pair, same_traffic.filter(pl.col("agent") == SCALE_TOP))
    if pair["agent"][0] != SCALE_TOP and len(returns_of_both[0]) > 1:
        lead = paired_difference(*returns_of_both)

    # Someone close behind is no end of an episode, so it is counted by episode.
    behind = mean_interval(pair["soft_crash_behind"].to_numpy())
    score, reason = _score(pair, same_traffic)

    return {
        "agent": pair["agent"][0],
        "traffic": pair["traffic"][0],
        "episodes": pair.height,
        "goal": ended["goal"],
        "hard_crash": ended["hard_crash"],
        "soft_crash": int(pair["had_soft_crash"].sum()),
        "out_of_road": ended["out_of_road"],
        "missed_exit": ended["missed_exit"],
        "timeout": ended["timeout"],
        "scene_end": ended["scene_end"],
        "soft_crash_onsets": int(pair["soft_crash"].sum()),
        "soft_crash_behind_onsets": int(pair["soft_crash_behind"].sum()),
        **entries("soft_crash_behind_per_episode", behind),
        **entries("mean_reward", mean_interval(returns)),
        "reward_sd": float(np.std(returns, ddof=1)) if len(returns) > 1 else None,
        **speed_and_lane_changes(pair),
        "distance_km": distance_m / 1000.0,
        **entries("hard_crash_share", crash_share),
        **entries("out_of_road_share", departure_share),
        **entries("crashes_per_1000_km", crashes),
        **entries("minus_mobil", lead),
        **entries("normalized_percent", score),
        "normalized_percent_reason": reason,
    }


def counts_of_ends(episodes: pl.DataFrame, ends: Iterable[str]) -> dict[str, int]:
    """How many episodes ended so, by end."""
    return {end: int((episodes["reason"] == end).sum()) for end in ends}


def speed_and_lane_changes(episodes: pl.DataFrame) -> Row:
    """``mean_speed_mps`` and ``lane_changes_per_km``; None where nobody drove.

    Rates are of all episodes together, not means of the episodes' own rates: short episodes would
    count as much as long ones.
    """
    distance_m = float(episodes["distance_m"].sum())
    duration_s = float(episodes["duration_s"].sum())
    changes = int(episodes["lane_changes"].sum())
    return {
        "mean_speed_mps": distance_m / duration_s if duration_s > 0.0 else None,
        "lane_changes_per_km": changes / distance_m * 1000.0 if distance_m > 0.0 else None,
    }


def _paired(*drivers: pl.DataFrame, what: pl.Expr = _RETURN) -> list[Array]:
    """``what`` of each of ``drivers`` on the E episodes that all of them drove, in one order.

    A list of doubles [E], one for each driver.
    """
    # Each join leaves the episodes that one more driver has driven, too.
    shared = drivers[0].select(_EPISODE)
    for column, driver in enumerate(drivers):
        # Columns are named by the driver's place: two drivers may have one name.
        values = driver.select(*_EPISODE, what.alias(str(column)))
        shared = shared.join(values, on=_EPISODE)

    # Joins keep no order.
    ordered = shared.sort(_EPISODE)
    return [ordered[str(column)].cast(pl.Float64).to_numpy() for column in range(len(drivers))]


def verdict(lead: Estimate, differences: Array, one_failed: npt.NDArray[np.bool_]) -> str:
    """``above``, ``below`` or ``undecided``: the sign of a ``lead``, where it is decided.

    Decided is what at least 30 episodes say, whose interval and sign-flip test both exclude that
    the drivers are equal. Where one driver alone failed in fewer than five episodes, the other
    episodes must say the same.

    Args:
        lead: the mean of ``differences`` with its interval.
        differences: of the returns, by episode, [E].
        one_failed: whether exactly one of the drivers crashed or left the road, [E].
    """
    decided = (
        len(differences) >= FEWEST_EPISODES
        and lead.excludes_zero()
        and sign_flip_p(differences) <= _SIGNIFICANT
    )
    if not decided:
        return "undecided"

    side = "above" if lead.value > 0.0 else "below"
    if not 0 < one_failed.sum() < FEWEST_FAILURES:
        return side

    # The same question without the few episodes in which one failed.
    rest = differences[~one_failed]
    # None of those is left, so there is no third look.
    nobody_failed = np.zeros(len(rest), dtype=bool)
    side_of_rest = verdict(mean_interval(rest), rest, nobody_failed)
    return side if side_of_rest == side else "undecided"


def paired_rows(episodes: pl.DataFrame) -> list[Row]:
    """The first driver against each of the others, traffic by traffic.

    ``episodes`` as for :func:`evaluation_rows`.

    Returns:
        Per traffic and other driver ``agent, over, traffic, episodes`` (driven by both), ``lead``
        (mean return of ``agent`` minus that of ``over``), ``lead_ci`` (95 %) and ``verdict``:
        ``above`` or ``below`` as :func:`verdict` decides, else ``undecided``. Pairs that share
        fewer than two episodes are left out.
    """
    first = episodes["agent"][0]
    rows = []
    for (traffic,), driven in episodes.group_by("traffic", maintain_order=True):
        # The first agent of the command is held against all others.
        ours = driven.filter(pl.col("agent") == first)
        others = driven.filter(pl.col("agent") != first)
        for (other,), theirs in others.group_by("agent", maintain_order=True):
            returns = _paired(ours, theirs)
            if len(returns[0]) < 2:
                continue

            failed = _paired(ours, theirs, what=pl.col("reason").is_in(FAILURES))
            one_failed = failed[0] != failed[1]
            lead = paired_difference(*returns)
            rows.append(
                {
                    "agent": first,
                    "over": other,
                    "traffic": traffic,
                    "episodes": len(returns[0]),
                    **entries("lead", lead),
                    "verdict": verdict(lead, returns[0] - returns[1], one_failed),
                }
            )
    return rows


def _score(pair: pl.DataFrame, same_traffic: pl.DataFrame) -> tuple[Estimate | None, str | None]:
    """The normalised score of one agent, from the episodes that it shares with the scale's drivers.

    As :func:`normalized_percent` gives it.
    """
    drivers = [pair]
    for name in (SCALE_TOP, SCALE_BOTTOM):
        driver = same_traffic.filter(pl.col("agent") == name)
        # Who asks for other drivers than those of the scale gets a reason in place of a score.
        if driver.height == 0:
            needed = f"needs {SCALE_TOP} and {SCALE_BOTTOM} among the agents"
            return None, f"{needed}; {name} is missing"
        drivers.append(driver)

    # Episodes that one of the three did not drive would shift the scale.
    returns = _paired(*drivers)
    if len(returns[0]) < 2:
        return None, "fewer than two episodes are shared by the drivers"
    agent, mobil, random_legal = returns
    return normalized_percent(agent, mobil, random_legal)


def normalized_percent(
    agent: npt.ArrayLike,
    mobil: npt.ArrayLike,
    random_legal: npt.ArrayLike,
) -> tuple[Estimate | None, str | None]:
    """The paper's '% of MOBIL': 0 for ``random_legal``, 100 for MOBIL.

    It is ``100 (R - R_0) / (R_MOBIL - R_0)``. This form fits both rows of the paper's Table VII; a
    plain ratio of mean rewards has no meaning where rewards can be negative. The interval resamples
    episodes, all drivers together; resamples in which MOBIL's lead over the random driver is
    exactly 0 are left out.

    Args:
        agent, mobil, random_legal: their returns on the same episodes, in the same order, [E].

    Returns:
        The score, and None; or None, and the reason why there is no score: the paired interval of
        MOBIL's lead over the random driver includes 0, so the scale would have no length.
    """
    drivers = (agent, mobil, random_legal)
    # [E, 3], so that a resample draws episodes and not drivers.
    returns = np.stack([np.asarray(values, dtype=np.float64) for values in drivers], axis=1)

    # The scale has a length only if MOBIL is better than random driving beyond doubt.
    lead = paired_difference(returns[:, 1], returns[:, 2])
    if lead.interval is None:
        return None, "fewer than two episodes"
    if not lead.excludes_zero():
        interval = f"{lead.low:.1f} to {lead.high:.1f}"
        return None, f"the interval of mobil's lead over random_legal includes 0 ({interval})"

    means = bootstrap_means(returns)
    # A resample without MOBIL's lead would divide by zero.
    with_scale = means[means[:, 1] != means[:, 2]]
    low, high = np.quantile(percent_of_way(*with_scale.T), TAIL_LEVELS)

    # The value itself is of all episodes, not of the resamples.
    value = percent_of_way(*returns.mean(axis=0))
    return Estimate(float(value), float(low), float(high)), None


def crashes_by_scene(episodes: pl.DataFrame, scenes: Sequence[str]) -> tuple[Estimate, list[Row]]:
    """Crashes per km on recorded scenes, with intervals that know how few scenes there are.

    Episodes of one scene start a tenth of a second apart among the same drivers, so they are no
    independent observations: whole scenes are resampled, and the ratio (all crashes over all km) is
    taken anew in each resample.

    Args:
        episodes: ``reason`` and ``distance_m`` per episode, of one driver.
        scenes: the scene of each of them
            (:meth:`ganlane.traffic.ReplayTraffic.scenes_of_episodes`).

    Returns:
        Hard crashes per km of all scenes together, with the 95 % interval of the bootstrap over
        scenes; no interval with fewer than two scenes. Where nobody crashed the upper bound is
        Poisson's exact one for the distance driven, since resampling zeros gives zero. And one row
        per scene, by name: ``scene, episodes, hard_crash, distance_km, crashes_per_km`` (None where
        nothing was driven) and ``crashes_per_km_ci`` (exact, Poisson, as if its episodes were
        independent).

    Raises:
        UserError: not one scene per episode, or nobody drove.
    """
    if len(scenes) != episodes.height:
        raise UserError(
            f"{len(scenes)} scenes for {episodes.height} episodes: expected one for each."
        )

    with_scene = episodes.with_columns(pl.Series("scene", scenes, pl.String))
    by_scene = with_scene.group_by("scene").agg(
        episodes=pl.len(),
        hard_crash=(pl.col("reason") == _CRASH).sum(),
        distance_km=pl.col("distance_m").cast(pl.Float64).sum() / 1000.0,
    )
    # Groups come in any order.
    by_scene = by_scene.sort("scene")

    rows = []
    for row in by_scene.to_dicts():
        km = row["distance_km"]
        rate = poisson_interval(row[_CRASH]).scaled(per=km) if km > 0.0 else None
        rows.append({**row, **entries("crashes_per_km", rate)})

    # Crashes and km of each scene.
    crashes = by_scene[_CRASH].to_numpy().astype(np.float64)
    driven = by_scene["distance_km"].to_numpy()
    total = float(driven.sum())
    if not total > 0.0:
        raise UserError(
            "crashes per km: nobody drove; give episodes that last at least one decision."
        )
    rate_of_all = float(crashes.sum() / total)

    # One scene has no spread to resample.
    if len(driven) < 2:
        return Estimate(rate_of_all), rows
    if crashes.sum() == 0:
        return poisson_interval(0).scaled(per=total), rows

    # A resample may hold nothing but scenes in which nobody drove.
    driven = driven.clip(min=np.finfo(np.float64).tiny)
    ratios = []
    for counts in resample_counts(len(driven), RESAMPLES):
        ratios.append(counts @ crashes / (counts @ driven))
    low, high = np.quantile(np.concatenate(ratios), TAIL_LEVELS)
    return Estimate(rate_of_all, float(low), float(high)), rows


def failed_episodes(episodes: pl.DataFrame) -> list[Row]:
    """Every crash and departure.

    ``episodes`` as for :func:`evaluation_rows`.

    Returns:
        Per ``driver, traffic, seed`` the numbers of the episodes that ended so: lists
        ``hard_crash`` and ``out_of_road``. Who never failed has no row.
    """
    failed = episodes.filter(pl.col("reason").is_in(FAILURES))
    # A row per driver, traffic and seed, so that an episode can be driven again by its numbers.
    names = (pl.col("agent").alias("driver"), "traffic", "seed")
    ended = {}
    for end in FAILURES:
        ended[end] = pl.col("episode").filter(pl.col("reason") == end).sort()
    return failed.group_by(*names, maintain_order=True).agg(**ended).to_dicts()
