"""What a recording says about driving: everything that a generator's weights carry along as plain numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import polars as pl

from ganlane.data.distributions import Distribution, Durations, describe
from ganlane.data.exposure import Exposure, measure_exposure
from ganlane.data.following import follower_headways
from ganlane.data.lane_change_statistics import LaneChangeStatistics, lane_change_statistics
from ganlane.data.lane_changes import lane_changes_of_frame
from ganlane.data.smoothing import raw_accelerations, smoothed_accelerations
from ganlane.errors import UserError


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
