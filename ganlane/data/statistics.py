"""Driving statistics of a recording or simulation.

Exposure, lane changes, speeds, accelerations, headways.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import ArrayLike
from scipy.special import gammaincinv  # scipy.stats takes seconds to import

from ganlane.data.lanes import (
    Flags,
    Floats,
    LaneChanges,
    find_lane_changes,
    tracks_of_frame,
)
from ganlane.data.schema import FRAME_S, TRACK, TRACK_STRIDE
from ganlane.errors import UserError
from ganlane.settings.record import Record, make, plain

#: Levels of the stored quantiles: fine enough to sample from by linear interpolation.
LEVELS = (
    0.01,
    *(round(0.05 * k, 2) for k in range(1, 20)),
    0.99,
)
#: A vehicle follows its leader up to this gap, m, and at this speed or faster, m/s. The gap of a
#: standing car, m (Table V's ``s_0``), is not part of the headway.
_FOLLOWING_GAP_M = 70.0
_MIN_FOLLOWER_MPS = 2.0
_STANDSTILL_GAP_M = 2.0


@dataclass(frozen=True)
class Distribution(Record):
    """Number, mean, standard deviation and quantiles (at :data:`LEVELS`) of a sample.

    An empty sample has ``mean`` None and no quantiles; fewer than two samples have ``sd`` None.
    """

    count: int
    mean: float | None = None
    sd: float | None = None
    quantiles: tuple[float, ...] = ()

    def quantile(self, level: float) -> float:
        """Value at ``level``, linear between :data:`LEVELS` and constant beyond them."""
        return float(np.interp(level, LEVELS, self.quantiles))


def describe(values: ArrayLike) -> Distribution:
    """Summarise a sample without NaN."""
    sample = np.asarray(values, dtype=np.float64)
    if not len(sample):
        return Distribution(0)
    # One sample has no spread.
    sd = float(sample.std(ddof=1)) if len(sample) > 1 else None
    quantiles = tuple(np.quantile(sample, LEVELS).tolist())
    return Distribution(len(sample), float(sample.mean()), sd, quantiles)


@dataclass(frozen=True)
class Durations(Record):
    """Durations of which some are censored, s.

    Attributes:
        complete: the complete ones; their mean is too low, since long durations are censored more
            often.
        censored: number of censored ones.
        survival_mean_s: area under :func:`survival_curve`, up to the longest duration; None without
            complete ones.
        survival_median_s: where that curve falls to one half; None if it never does.
    """

    complete: Distribution
    censored: int
    survival_mean_s: float | None
    survival_median_s: float | None


def describe_durations(duration_s: Floats, complete: Flags) -> Durations:
    """Summarise durations [C], of which those not ``complete`` [C] are lower bounds."""
    mean = median = None
    # Without a complete duration the curve stays at 1.
    if complete.any():
        ends, survival = survival_curve(duration_s, complete)
        # The area under a step curve, up to the longest duration.
        edges = np.concatenate(([0.0], ends, [duration_s.max()]))
        mean = float(np.sum(np.diff(edges) * np.concatenate(([1.0], survival))))
        # The first time at which half of them have ended.
        halved = np.flatnonzero(survival <= 0.5)
        median = float(ends[halved[0]]) if len(halved) else None
    censored = int(np.count_nonzero(~complete))
    return Durations(describe(duration_s[complete]), censored, mean, median)


def survival_curve(duration_s: Floats, complete: Flags) -> tuple[np.ndarray, np.ndarray]:
    """Kaplan and Meier's (1958) survival curve of durations [C].

    Those not ``complete`` are lower bounds.

    Returns [E] the distinct complete durations, growing, and [E] the shares of longer durations,
    falling.
    """
    ends, ending = np.unique(duration_s[complete], return_counts=True)
    # Those that last at least as long.
    shorter = np.searchsorted(np.sort(duration_s), ends)
    at_risk = len(duration_s) - shorter
    return ends, np.cumprod(1.0 - ending / at_risk)


@dataclass(frozen=True)
class Exposure(Record):
    """Amount of driving.

    Attributes:
        scenes, tracks: number of them.
        cars: counted once per scene.
        samples: rows, one per vehicle and frame.
        road_m: the road's mean length over the cars.
        vehicle_km: distance driven, km.
    """

    scenes: int
    tracks: int
    cars: int
    samples: int
    road_m: float
    vehicle_km: float


def measure_exposure(frame: pl.DataFrame) -> Exposure:
    """Scenes, tracks, cars, length of road and distance driven of a frame in the schema."""
    # The road is as long as positions in the scene reach.
    roads = frame.group_by("scene").agg(
        road=pl.col("x").max() - pl.col("x").min(),
        cars=(pl.col("vehicle") % TRACK_STRIDE).n_unique(),
    )
    # Weighted by cars, as equation 9 counts them.
    road_m = np.average(roads["road"].to_numpy(), weights=roads["cars"].to_numpy())

    # The length of each track as it was driven, lane changes included.
    squares = [pl.col(name).diff().over(TRACK) ** 2 for name in ("x", "y")]
    distance = pl.sum_horizontal(*squares).sqrt().sum()
    driven_m = float(frame.select(distance).item())
    return Exposure(
        scenes=roads.height,
        tracks=frame.select(TRACK).n_unique(),
        cars=int(roads["cars"].sum()),
        samples=frame.height,
        road_m=float(road_m),
        vehicle_km=driven_m / 1000.0,
    )


def leader_gaps(frame: pl.DataFrame) -> pl.DataFrame:
    """Rows of a frame in the schema that have a leader, with its ``gap`` and ``leader_speed``.

    The leader is the next vehicle ahead in the same lane and frame, at any distance; ``gap`` is net
    (bumper to bumper), m, negative where two bodies overlap along the road.
    """
    # Sorted along the road, the next row of the same lane and frame is the leader.
    ordered = frame.sort("scene", "frame", "lane", "x")
    ahead = {}
    for name in ("x", "length", "speed"):
        ahead[name] = pl.col(name).shift(-1).over("scene", "frame", "lane")
    # Positions are those of the bodies' centres, so half of both lengths lies between.
    gap = ahead["x"] - pl.col("x") - 0.5 * (ahead["length"] + pl.col("length"))
    # Null where nobody is ahead.
    return ordered.with_columns(gap=gap, leader_speed=ahead["speed"]).drop_nulls("gap")


def quantities(frame: pl.DataFrame) -> dict[str, np.ndarray]:
    """Samples of every quantity of a frame in the schema, sorted.

    Returns:
        By name, each of any length:

        - ``speed``: as recorded, m/s.
        - ``acceleration_raw``: differences of the recorded speed between frames, m/s2; mostly noise
          in raw recordings.
        - ``acceleration_smoothed``: ``(x[t] - 2 x[t - 1 s] + x[t - 2 s]) / (1 s)^2``, the true
          acceleration weighted by a triangle of two seconds' width, m/s2; none in tracks of less
          than two seconds.
        - ``gap``: to the leader (:func:`leader_gaps`), m.
        - ``time_headway``: ``gap / speed`` of followers, s: a gap of 0 to 70 m, at least 2 m/s.
        - ``headway``: each follower's median of ``(gap - 2 m) / speed``, s, over at least 1 s; in
          the order of the tracks.
    """
    # Frames in a second.
    lag = round(1.0 / FRAME_S)

    def earlier(column: str, frames: int) -> pl.Expr:
        """The column's value ``frames`` earlier in the same track.

        Null where any frame in between is missing.
        """
        same = pl.col("frame").shift(frames).over(TRACK) == pl.col("frame") - frames
        return pl.when(same).then(pl.col(column).shift(frames).over(TRACK))

    # Second differences over a second, which noise of a frame does not reach.
    second_difference = pl.col("x") - 2.0 * earlier("x", lag) + earlier("x", 2 * lag)
    accelerations = frame.select(
        raw=(pl.col("speed") - earlier("speed", 1)) / FRAME_S,
        smoothed=second_difference / (lag * FRAME_S) ** 2,
    )

    # Sorting needs most memory: only once, and with no more columns than needed.
    columns = frame.select(*TRACK, "frame", "x", "speed", "lane", "length")
    with_leader = leader_gaps(columns).select(*TRACK, "speed", "gap")
    # Further away a leader has no influence.
    close = pl.col("gap").is_between(0.0, _FOLLOWING_GAP_M)
    following = with_leader.filter(close & (pl.col("speed") >= _MIN_FOLLOWER_MPS))
    headway = (pl.col("gap") - _STANDSTILL_GAP_M) / pl.col("speed")
    # One number per driver: a long track counts no more than a short one.
    per_follower = following.group_by(TRACK).agg(headway.median().alias("headway"), pl.len())
    long_enough = per_follower.filter(pl.col("len") >= lag).sort(TRACK)
    return {
        "speed": frame["speed"].to_numpy(),
        "acceleration_raw": accelerations["raw"].drop_nulls().to_numpy(),
        "acceleration_smoothed": accelerations["smoothed"].drop_nulls().to_numpy(),
        "headway": long_enough["headway"].to_numpy(),
        "time_headway": (following["gap"] / following["speed"]).to_numpy(),
        "gap": with_leader["gap"].to_numpy(),
    }


def poisson_interval(count: int) -> tuple[float, float]:
    """Exact 95 % confidence interval of a Poisson mean after ``count`` events (Garwood 1936)."""
    tail = 0.5 * (1.0 - 0.95)
    # Quantiles of gamma distributions; after no event the lower bound is 0.
    low = gammaincinv(count, tail) if count else 0.0
    high = gammaincinv(count + 1, 1.0 - tail)
    return float(low), float(high)


@dataclass(frozen=True)
class LaneChangeStatistics(Record):
    """Rates, durations and lateral speeds of lane changes (equations 9, 10 and 11).

    Attributes:
        count: number of lane changes (:mod:`ganlane.data.lanes` defines what counts).
        srlc: equation 9, per vehicle and km of road; too low where tracks cover only part of the
            road.
        per_vehicle_km, per_vehicle_km_low, per_vehicle_km_high: per driven km, with its exact 95 %
            interval.
        t_m_srlc_steps, t_m_vehicle_km_steps: equation 10's ``t_m``, the mean time between two lane
            changes of a vehicle, from either rate and the mean speed, in steps of 0.1 s; None
            without lane changes.
        duration: equation 11, s.
        lateral_speed: mean lateral speed of each complete change, m/s; its ``mean`` and ``sd`` are
            the Gaussian.
        lateral_speed_with_censored: the same of all changes, over their recorded parts.
    """

    count: int
    srlc: float
    per_vehicle_km: float
    per_vehicle_km_low: float
    per_vehicle_km_high: float
    t_m_srlc_steps: float | None
    t_m_vehicle_km_steps: float | None
    duration: Durations
    lateral_speed: Distribution
    lateral_speed_with_censored: Distribution


def lane_change_statistics(
    changes: LaneChanges,
    exposure: Exposure,
    speed: Floats,
) -> LaneChangeStatistics:
    """Statistics of lane changes found in that much driving at the speeds [R], m/s."""
    n = len(changes)
    km = exposure.vehicle_km
    low, high = poisson_interval(n)
    speed_mps = float(speed.mean())
    # Two rates: per car and km of road (equation 9), and per km driven.
    by_road = n / exposure.cars * 1000.0 / exposure.road_m
    by_distance = n / km
    return LaneChangeStatistics(
        count=n,
        srlc=by_road,
        per_vehicle_km=by_distance,
        per_vehicle_km_low=low / km,
        per_vehicle_km_high=high / km,
        t_m_srlc_steps=1000.0 / (by_road * speed_mps * FRAME_S) if n else None,
        t_m_vehicle_km_steps=1000.0 / (by_distance * speed_mps * FRAME_S) if n else None,
        duration=describe_durations(changes.duration_s, changes.complete),
        lateral_speed=describe(changes.lateral_speed[changes.complete]),
        lateral_speed_with_censored=describe(changes.lateral_speed),
    )


@dataclass(frozen=True)
class DrivingStatistics(Record):
    """Statistics of a recording in SI units.

    :meth:`to_dict` and :meth:`from_dict` are exact inverses.

    ``speed_sd_in_frame`` and ``speed_sd_in_lane`` are standard deviations of the speeds within a
    frame, and within a frame and lane, m/s: the mean over those with two vehicles or more, None
    without any. The distributions are of :func:`quantities`.
    """

    exposure: Exposure
    lane_changes: LaneChangeStatistics
    speed: Distribution
    speed_sd_in_frame: float | None
    speed_sd_in_lane: float | None
    acceleration_raw: Distribution
    acceleration_smoothed: Distribution
    headway: Distribution

    def to_dict(self) -> dict[str, Any]:
        """Nested dictionaries of numbers, None and lists, as in JSON."""
        return plain(self)

    @classmethod
    def from_dict(cls, numbers: Mapping[str, Any]) -> DrivingStatistics:
        """The statistics that :meth:`to_dict` wrote.

        Raises:
            UserError: a name is missing or unknown, or a value of another type.
        """
        try:
            return make(cls, numbers)
        except (UserError, TypeError) as error:
            raise UserError(
                f"not the statistics of a recording ({error}); measure them again."
            ) from error


def driving_statistics(frame: pl.DataFrame) -> DrivingStatistics:
    """Measure a frame in the schema, sorted; each scene's lane width is estimated."""
    exposure = measure_exposure(frame)
    samples = quantities(frame)
    changes = find_lane_changes(tracks_of_frame(frame))
    return DrivingStatistics(
        exposure=exposure,
        lane_changes=lane_change_statistics(changes, exposure, samples["speed"]),
        speed=describe(samples["speed"]),
        speed_sd_in_frame=_mean_spread(frame, ["scene", "frame"]),
        speed_sd_in_lane=_mean_spread(frame, ["scene", "frame", "lane"]),
        acceleration_raw=describe(samples["acceleration_raw"]),
        acceleration_smoothed=describe(samples["acceleration_smoothed"]),
        headway=describe(samples["headway"]),
    )


def _mean_spread(frame: pl.DataFrame, groups: list[str]) -> float | None:
    """Mean of the standard deviations of the speeds within groups of rows, m/s; None without any.

    ``groups`` are the columns that a group has in common.
    """
    # In the order of the rows, so that the mean is the same to the last bit in every run.
    spreads = frame.group_by(groups, maintain_order=True).agg(pl.col("speed").std())
    # One vehicle has no deviation; the mean of nothing is None.
    return spreads["speed"].drop_nulls().mean()  # type: ignore[return-value]
