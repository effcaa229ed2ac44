"""How many crashes nobody could have avoided: a bound, from drivers that came through and from a search.

An episode counts as avoidable once some sequence of actions brings the ego through it without a hard crash. First
come the rides of ordinary drivers, which cost little; the episodes in which all of them crashed are searched with
beams of growing size (:mod:`ganlane.evaluation.beam_search`). A sequence that a search
found is driven again before it counts. What is left is an upper bound of the unavoidable share, and it falls with the
beam.

The bound belongs to a driver who knows what comes and who, like every driver here, decides on lanes alone: the ego's
speed is IDM's. Who does not know what comes will do worse.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from torchrl.envs import EnvBase

from ganlane.evaluation.beam_search import beam_search
from ganlane.evaluation.counts import clopper_pearson
from ganlane.evaluation.rides import SIDES, Ride, replay

#: The first stage: rides of ordinary drivers. The others are named after their beams.
DRIVERS = "drivers"


@dataclass(frozen=True)
class Way:
    """A way through an episode; where none was found, one to a crash.

    Attributes:
        stage: ``drivers`` or ``beam K``: what found it; None where nobody came through.
        ride: with the actions; None where nobody has driven this episode yet.
        widest: most states alive at once in the last search; 0 where there was none. Below the beam, the search
            dropped nothing but like states.
    """

    episode: int
    stage: str | None = None
    ride: Ride | None = None
    widest: int = 0


def stage_of(beam: int) -> str:
    """The name of the search with ``beam``."""
    return f"beam {beam}"


def ways_of_drivers(driven: Iterable[Sequence[Ride]], episodes: Sequence[int]) -> list[Way]:
    """Which of ``episodes`` ordinary drivers came through, by the ride with the highest return; one way each."""
    best: dict[int, Ride] = {}
    for ride in sorted((ride for rides in driven for ride in rides), key=lambda ride: (ride.safe, ride.reward)):
        best[ride.episode] = ride
    rides = [(number, best.get(number)) for number in episodes]
    return [Way(number, DRIVERS if ride is not None and ride.safe else None, ride) for number, ride in rides]


def search_left(env: EnvBase, ways: Sequence[Way], seed: int, beam: int) -> list[Way]:
    """``ways`` with those of episodes of ``seed`` that had none searched for, and driven again, in ``env``."""
    left = [way.episode for way in ways if way.stage is None]
    if not left:
        return list(ways)
    plans = {plan.episode: plan for plan in beam_search(env, left, seed, beam)}
    rides = replay(env, {number: plan.actions for number, plan in plans.items()}, seed)
    stages = {ride.episode: stage_of(beam) if ride.safe else None for ride in rides}
    found = {r.episode: Way(r.episode, stages[r.episode], r, plans[r.episode].widest) for r in rides}
    return [found.get(way.episode, way) for way in ways]


def floor_rows(ways: Sequence[Way], beams: Sequence[int]) -> list[dict[str, Any]]:
    """Per stage: ``searched_with, avoidable, not_avoided`` (counts so far), ``share, share_ci`` (exact, 95 %)."""
    rows, avoidable = [], 0
    for stage in (DRIVERS, *map(stage_of, beams)):
        avoidable += sum(way.stage == stage for way in ways)
        share = clopper_pearson(len(ways) - avoidable, len(ways))
        left = {"avoidable": avoidable, "not_avoided": len(ways) - avoidable}
        rows.append({"searched_with": stage, **left, "share": share.value, "share_ci": share.interval})
    return rows


def driver_row(name: str, rides: Sequence[Ride], ways: Sequence[Way]) -> dict[str, Any]:
    """A driver's crashes: how many, which of them were avoidable, what they hit and whether the ego kept its lane."""
    crashes = [ride for ride in rides if ride.end == "hard_crash"]
    avoidable = {way.episode for way in ways if way.stage is not None}
    share = clopper_pearson(len(crashes), len(rides))
    return {
        "driver": name,
        "episodes": len(rides),
        "hard_crash": len(crashes),
        "share": share.value,
        "share_ci": share.interval,
        "avoidable": sum(ride.episode in avoidable for ride in crashes),
        **{side: sum(ride.contact == side for ride in crashes) for side in SIDES[1:]},
        "keeping_lane": sum(not ride.changing for ride in crashes),
        "keeping_lane_hit_from_side_or_behind": sum(
            not ride.changing and ride.contact in ("side", "behind") for ride in crashes
        ),
        "mean_reward": sum(ride.reward for ride in rides) / len(rides),
    }
