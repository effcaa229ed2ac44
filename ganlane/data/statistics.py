"""Driving statistics of a recording or simulation: exposure, lane changes, speeds, accelerations, headways."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
import polars as pl
from scipy.special import gammaincinv  # scipy.stats takes seconds to import

from ganlane.data.distributions import Distribution, Durations, describe, describe_durations
from ganlane.data.lane_changes import LaneChanges, find_lane_changes
from ganlane.data.schema import FRAME_S, TRACK, TRACK_STRIDE
from ganlane.data.tracks import tracks_of_frame
from ganlane.errors import UserError

#: Gap of a standing car to its leader, m (Table V's ``s_0``): not part of the headway.
STANDSTILL_GAP_M: Final = 2.0
#: A vehicle follows its leader up to this gap, m, and at this speed or faster, m/s.
FOLLOWING_GAP_M: Final = 70.0
MIN_FOLLOWER_MPS: Final = 2.0
#: A follower's headway is measured over at least 1 s.
MIN_FRAMES: Final = 10


@dataclass(frozen=True)
class Exposure:
    """Amount of driving: the denominator of every rate.

    ``cars`` counts a car once per scene, however many tracks it has; ``road_m`` is the mean length of the road over
    the cars; ``vehicle_km`` is the distance driven.
    """

    scenes: int
    tracks: int
    cars: int
    samples: int
    road_m: float
    vehicle_km: float


def measure_exposure(frame: pl.DataFrame) -> Exposure:
    """Scenes, tracks, cars, length of road and distance driven of a frame in the schema."""
    roads = frame.group_by("scene").agg(
        road=pl.col("x").max() - pl.col("x").min(), cars=(pl.col("vehicle") % TRACK_STRIDE).n_unique()
    )
    driven = (pl.col(name).diff().over(TRACK) ** 2 for name in ("x", "y"))
    return Exposure(
        scenes=roads.height,
        tracks=frame.select(TRACK).n_unique(),
        cars=int(roads["cars"].sum()),
        samples=frame.height,
        road_m=float(np.average(roads["road"].to_numpy(), weights=roads["cars"].to_numpy())),
        vehicle_km=float(frame.select(pl.sum_horizontal(*driven).sqrt().sum()).item()) / 1000.0,
    )


def leader_gaps(frame: pl.DataFrame) -> pl.DataFrame:
    """Rows that have a leader, with its ``gap`` and ``leader_speed``.

    The leader is the next vehicle ahead in the same lane and frame, at any distance; ``gap`` is net (bumper to
    bumper), m, negative where two bodies overlap along the road.

    Args:
        frame: in the schema.
    """
    ahead = {name: pl.col(name).shift(-1).over("scene", "frame", "lane") for name in ("x", "length", "speed")}
    gap = ahead["x"] - pl.col("x") - 0.5 * (ahead["length"] + pl.col("length"))
    ordered = frame.sort("scene", "frame", "lane", "x")
    return ordered.with_columns(gap=gap, leader_speed=ahead["speed"]).drop_nulls("gap")


def followers(with_leader: pl.DataFrame) -> pl.DataFrame:
    """Rows of :func:`leader_gaps` in which a vehicle follows: gap of 0 to 70 m, speed of at least 2 m/s."""
    close = pl.col("gap").is_between(0.0, FOLLOWING_GAP_M)
    return with_leader.filter(close & (pl.col("speed") >= MIN_FOLLOWER_MPS))


def median_headways(following: pl.DataFrame) -> pl.Series:
    """Median of ``(gap - 2 m) / speed`` of every follower, s: one number per track, in the order of the tracks.

    Args:
        following: rows of :func:`followers`; tracks with less than 1 s of them are left out.
    """
    headway = (pl.col("gap") - STANDSTILL_GAP_M) / pl.col("speed")
    per_track = following.group_by(TRACK).agg(headway.median().alias("headway"), pl.len())
    return per_track.filter(pl.col("len") >= MIN_FRAMES).sort(TRACK)["headway"]


def follower_headways(frame: pl.DataFrame) -> pl.Series:
    """:func:`median_headways` of a frame in the schema."""
    return median_headways(followers(leader_gaps(frame)))


def raw_accelerations(frame: pl.DataFrame) -> pl.Series:
    """Differences of the recorded speed between frames, m/s2; mostly noise in raw recordings."""
    steps = frame.select(((pl.col("speed") - _earlier("speed", 1)) / FRAME_S).alias("acceleration"))
    return steps["acceleration"].drop_nulls()


def smoothed_accelerations(frame: pl.DataFrame, over_s: float = 1.0) -> pl.Series:
    """Mean speed of one second minus the mean speed of the second before, per second, m/s2.

    The filter is ``(x[t] - 2 x[t - k] + x[t - 2k]) / (k * 0.1 s)^2`` with ``k`` frames in ``over_s``: the true
    acceleration weighted by a triangle of two seconds' width. It uses positions, so recordings and simulations are
    treated alike; a track of less than two seconds gives no value. For statistics only: a generator's windows must
    not be built from smoothed positions, which leak the future into the past.
    """
    lag = round(over_s / FRAME_S)
    bend = (pl.col("x") - 2.0 * _earlier("x", lag) + _earlier("x", 2 * lag)) / (lag * FRAME_S) ** 2
    return frame.select(bend.alias("acceleration"))["acceleration"].drop_nulls()


def _earlier(column: str, frames: int) -> pl.Expr:
    """The column's value ``frames`` earlier in the same track; null where any frame in between is missing."""
    same = pl.col("frame").shift(frames).over(TRACK) == pl.col("frame") - frames
    return pl.when(same).then(pl.col(column).shift(frames).over(TRACK))


def srlc(changes: int, vehicles: int, road_m: float) -> float:
    """Equation 9: lane changes per vehicle and kilometre of road, ``n / q * 1000 / L``.

    It assumes that every vehicle drives the whole road; where tracks cover only part of it, it is too low.

    Args:
        changes: ``n``, number of lane changes.
        vehicles: ``q``, number of vehicles.
        road_m: ``L``, length of the road, m.
    """
    return changes / vehicles * 1000.0 / road_m


def steps_between_changes(rate_per_km: float, speed_mps: float, step_s: float = FRAME_S) -> float:
    """Equation 10's ``t_m``: mean time between two lane changes of a vehicle, in steps of ``step_s``.

    Args:
        rate_per_km: lane changes per vehicle-kilometre, above 0.
        speed_mps: mean speed, m/s.
        step_s: s.
    """
    return 1000.0 / (rate_per_km * speed_mps * step_s)


def poisson_interval(count: int, level: float = 0.95) -> tuple[float, float]:
    """Exact confidence interval of a Poisson mean after ``count`` events (Garwood 1936)."""
    tail = 0.5 * (1.0 - level)
    low = gammaincinv(count, tail) if count else 0.0
    return float(low), float(gammaincinv(count + 1, 1.0 - tail))


@dataclass(frozen=True)
class LaneChangeStatistics:
    """Rates, durations and lateral speeds of lane changes (equations 9, 10 and 11).

    Attributes:
        count: number of lane changes (:mod:`ganlane.data.lane_changes` defines what counts).
        srlc: equation 9, per vehicle and km of road.
        per_vehicle_km, per_vehicle_km_low, per_vehicle_km_high: per driven km, with its exact 95 % interval.
        t_m_srlc_steps, t_m_vehicle_km_steps: equation 10's ``t_m`` from either rate and the mean speed, in steps
            of 0.1 s; None without lane changes.
        duration: equation 11, s.
        lateral_speed: mean lateral speed of each complete change, m/s; its ``mean`` and ``sd`` are the Gaussian.
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


def lane_change_statistics(changes: LaneChanges, exposure: Exposure, speed_mps: float) -> LaneChangeStatistics:
    """Statistics of lane changes found in that much driving at that mean speed, m/s."""
    n, km = len(changes), exposure.vehicle_km
    low, high = poisson_interval(n)
    by_road, by_distance = srlc(n, exposure.cars, exposure.road_m), n / km
    return LaneChangeStatistics(
        count=n,
        srlc=by_road,
        per_vehicle_km=by_distance,
        per_vehicle_km_low=low / km,
        per_vehicle_km_high=high / km,
        t_m_srlc_steps=steps_between_changes(by_road, speed_mps) if n else None,
        t_m_vehicle_km_steps=steps_between_changes(by_distance, speed_mps) if n else None,
        duration=describe_durations(changes.duration_s, changes.complete),
        lateral_speed=describe(changes.lateral_speed[changes.complete]),
        lateral_speed_with_censored=describe(changes.lateral_speed),
    )


@dataclass(frozen=True)
class DrivingStatistics:
    """Statistics of a recording in SI units; :meth:`to_dict` and :meth:`from_dict` are exact inverses.

    Attributes:
        exposure: amount of driving.
        lane_changes: rates, durations, lateral speeds.
        speed: of all samples, m/s.
        speed_sd_in_frame, speed_sd_in_lane: standard deviation of the speeds within a frame, and within a frame
            and lane, m/s; the mean over those with two vehicles or more, None without any.
        acceleration_raw, acceleration_smoothed: :func:`raw_accelerations`, :func:`smoothed_accelerations`, m/s2.
        headway: median ``(gap - 2) / speed`` per follower, s (:func:`follower_headways`).
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
        return _tuples_to_lists(asdict(self))

    @classmethod
    def from_dict(cls, numbers: Mapping[str, Any]) -> DrivingStatistics:
        """The statistics that :meth:`to_dict` wrote.

        Raises:
            UserError: a name is missing or unknown.
        """
        try:
            changes = dict(numbers["lane_changes"])
            duration = dict(changes["duration"])
            duration["complete"] = _distribution(duration["complete"])
            changes["duration"] = Durations(**duration)
            for name in ("lateral_speed", "lateral_speed_with_censored"):
                changes[name] = _distribution(changes[name])
            fields = dict(numbers)
            for name in ("speed", "acceleration_raw", "acceleration_smoothed", "headway"):
                fields[name] = _distribution(fields[name])
            fields["exposure"] = Exposure(**numbers["exposure"])
            fields["lane_changes"] = LaneChangeStatistics(**changes)
            return cls(**fields)
        except (KeyError, TypeError) as error:
            raise UserError(f"not the statistics of a recording ({error}); measure them again.") from error


def driving_statistics(frame: pl.DataFrame, lane_widths: dict[str, float] | None = None) -> DrivingStatistics:
    """Measure a recording.

    Args:
        frame: in the schema, sorted by scene, vehicle and frame.
        lane_widths: width of each scene's lanes, m; by default estimated.
    """
    exposure = measure_exposure(frame)
    speed = describe(frame["speed"].to_numpy())
    changes = find_lane_changes(tracks_of_frame(frame, lane_widths))
    return DrivingStatistics(
        exposure=exposure,
        lane_changes=lane_change_statistics(changes, exposure, float(speed.mean or 0.0)),
        speed=speed,
        speed_sd_in_frame=_mean_spread(frame, ["scene", "frame"]),
        speed_sd_in_lane=_mean_spread(frame, ["scene", "frame", "lane"]),
        acceleration_raw=describe(raw_accelerations(frame).to_numpy()),
        acceleration_smoothed=describe(smoothed_accelerations(frame).to_numpy()),
        headway=describe(follower_headways(frame).to_numpy()),
    )


def _mean_spread(frame: pl.DataFrame, groups: list[str]) -> float | None:
    spread = frame.group_by(groups).agg(sd=pl.col("speed").std())["sd"].drop_nulls()
    return float(spread.mean()) if len(spread) else None  # type: ignore[arg-type]


def _distribution(numbers: Mapping[str, Any]) -> Distribution:
    return Distribution(**{**numbers, "quantiles": tuple(numbers["quantiles"])})


def _tuples_to_lists(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _tuples_to_lists(part) for name, part in value.items()}
    return [_tuples_to_lists(part) for part in value] if isinstance(value, tuple) else value
