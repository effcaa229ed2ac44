"""Who follows whom in a recording, and at what headway."""

from __future__ import annotations

from typing import Final

import polars as pl

from ganlane.data.schema import TRACK

#: Gap of a standing car to its leader, m (Table V's ``s_0``): not part of the headway.
STANDSTILL_GAP_M: Final = 2.0
#: A leader farther away than this is not followed; a follower slower than this shows no headway.
FOLLOWING_GAP_M: Final = 70.0
SLOWEST_FOLLOWER_MPS: Final = 2.0
#: A follower counts when it has followed for at least 1 s.
FEWEST_FRAMES: Final = 10


def leader_gaps(frame: pl.DataFrame) -> pl.DataFrame:
    """Rows that have a leader, with its ``gap`` and ``leader_speed``.

    The leader is the next vehicle ahead in the same lane and frame, however far; ``gap`` is net (bumper to
    bumper), m, negative where two bodies overlap along the road.

    Args:
        frame: in the schema.
    """
    ahead = {name: pl.col(name).shift(-1).over("scene", "frame", "lane") for name in ("x", "length", "speed")}
    gap = ahead["x"] - pl.col("x") - 0.5 * (ahead["length"] + pl.col("length"))
    lined_up = frame.sort("scene", "frame", "lane", "x")
    return lined_up.with_columns(gap=gap, leader_speed=ahead["speed"]).drop_nulls("gap")


def follower_headways(frame: pl.DataFrame) -> pl.Series:
    """Median of ``(gap - 2 m) / speed`` of every follower, s: one number per track, in the order of the tracks.

    Only rows count in which the leader is at most 70 m ahead and the follower does at least 2 m/s, and only
    tracks with at least 1 s of such rows (design: the trait 'headway').
    """
    return median_headways(followers(leader_gaps(frame)))


def followers(behind: pl.DataFrame) -> pl.DataFrame:
    """Those rows of :func:`leader_gaps` in which a vehicle follows: a leader within 70 m, and 2 m/s or more."""
    return behind.filter(pl.col("gap").is_between(0.0, FOLLOWING_GAP_M) & (pl.col("speed") >= SLOWEST_FOLLOWER_MPS))


def median_headways(following: pl.DataFrame) -> pl.Series:
    """The headways of :func:`follower_headways` from the rows of :func:`followers`."""
    headway = (pl.col("gap") - STANDSTILL_GAP_M) / pl.col("speed")
    per_track = following.group_by(TRACK).agg(headway.median().alias("headway"), pl.len())
    return per_track.filter(pl.col("len") >= FEWEST_FRAMES).sort(TRACK)["headway"]
