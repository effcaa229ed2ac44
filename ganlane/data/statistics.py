"""What a recording says about driving: everything that a generator's weights carry along as plain numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import polars as pl

from ganlane.data.distributions import Distribution, Durations, describe, describe_durations
from ganlane.data.following import follower_headways
from ganlane.data.lane_changes import LaneChanges, lane_changes_of_frame
from ganlane.data.rates import poisson_interval, srlc, steps_between_changes
from ganlane.data.schema import TRACK, TRACK_STRIDE
from ganlane.data.smoothing import raw_accelerations, smoothed_accelerations
from ganlane.errors import UserError


@dataclass(frozen=True)
class Exposure:
    """How much driving was seen.

    ``cars`` counts a car once per scene, whatever its tracks; ``road_m`` is the mean length of the road over the
    cars; ``vehicle_km`` is the distance driven.
    """

    scenes: int
    tracks: int
    cars: int
    samples: int
    road_m: float
    vehicle_km: float


@dataclass(frozen=True)
class LaneChangeStatistics:
    """How often, how long and how fast lanes are changed.

    Attributes:
        count: lane changes seen (:mod:`ganlane.data.lane_changes` says what counts).
        srlc: equation 9, per vehicle and km of road.
        per_vehicle_km, per_vehicle_km_low, per_vehicle_km_high: per driven km, with its exact 95 % interval.
        t_m_srlc_steps, t_m_vehicle_km_steps: equation 10's ``t_m`` from either rate and the mean speed, in steps
            of 0.1 s; None where no change was seen.
        duration: equation 11, s.
        lateral_speed: mean lateral speed of each complete change, m/s; its ``mean`` and ``sd`` are the Gaussian.
        lateral_speed_with_censored: the same of all changes, over what was seen of them.
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


@dataclass(frozen=True)
class DrivingStatistics:
    """Statistics of a recording in SI units; :meth:`to_dict` and :meth:`from_dict` are exact inverses.

    Attributes:
        exposure: how much driving was seen.
        lane_changes: rates, durations, lateral speeds.
        speed: of all samples, m/s.
        speed_sd_in_frame, speed_sd_in_lane: standard deviation of the speeds within a frame, and within a frame
            and lane, m/s; the mean over those with two vehicles or more, None without any.
        acceleration_raw, acceleration_smoothed: before and after the filter of :mod:`ganlane.data.smoothing`, m/s2.
        headway: median ``(gap - 2) / speed`` per follower, s (:func:`ganlane.data.following.follower_headways`).
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
        """Nested dictionaries of numbers, None and lists, as JSON has them."""
        return _listed(asdict(self))

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
            rest = {name: _distribution(numbers[name]) for name in _DISTRIBUTIONS}
            parts = {"exposure": Exposure(**numbers["exposure"]), "lane_changes": LaneChangeStatistics(**changes)}
            return cls(**{**numbers, **parts, **rest})
        except (KeyError, TypeError) as error:
            raise UserError(f"not the statistics of a recording ({error}); measure them again.") from error


_DISTRIBUTIONS = ("speed", "acceleration_raw", "acceleration_smoothed", "headway")


def driving_statistics(frame: pl.DataFrame, lane_widths: dict[str, float] | None = None) -> DrivingStatistics:
    """Measure a recording.

    Args:
        frame: in the schema, sorted by scene, vehicle and frame.
        lane_widths: width of each scene's lanes, m; by default estimated.
    """
    exposure = measure_exposure(frame)
    speed = describe(frame["speed"].to_numpy())
    changes = lane_changes_of_frame(frame, lane_widths)
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


def lane_change_statistics(changes: LaneChanges, exposure: Exposure, speed_mps: float) -> LaneChangeStatistics:
    """Rates, durations and lateral speeds of lane changes found in that much driving at that mean speed."""
    n, km = len(changes), exposure.vehicle_km
    low, high = poisson_interval(n)
    by_road = srlc(n, exposure.cars, exposure.road_m)
    by_distance = n / km
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


def _mean_spread(frame: pl.DataFrame, groups: list[str]) -> float | None:
    spread = frame.group_by(groups).agg(sd=pl.col("speed").std())["sd"].drop_nulls()
    return float(spread.mean()) if len(spread) else None  # type: ignore[arg-type]


def _distribution(numbers: Mapping[str, Any]) -> Distribution:
    return Distribution(**{**numbers, "quantiles": tuple(numbers["quantiles"])})


def _listed(value: Any) -> Any:
    """Tuples as lists, all the way down."""
    if isinstance(value, dict):
        return {name: _listed(part) for name, part in value.items()}
    return [_listed(part) for part in value] if isinstance(value, tuple) else value
