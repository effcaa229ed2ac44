"""How often, how long and how fast lanes are changed: equations 9, 10 and 11 of a recording or a simulation."""

from __future__ import annotations

from dataclasses import dataclass

from ganlane.data.distributions import Distribution, Durations, describe, describe_durations
from ganlane.data.exposure import Exposure
from ganlane.data.lane_changes import LaneChanges
from ganlane.data.rates import poisson_interval, srlc, steps_between_changes


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
