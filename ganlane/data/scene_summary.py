"""One scene in figures: a row of the report."""

from __future__ import annotations

from dataclasses import dataclass

from ganlane.data.exposure import Exposure
from ganlane.data.lane_change_statistics import lane_change_statistics
from ganlane.data.lane_changes import LaneChanges
from ganlane.data.source import Scene


@dataclass(frozen=True)
class SceneSummary:
    """One scene in figures.

    ``nearest_lane_share`` is the share of rows whose recorded lane is the one whose centre is nearest: near 1 where
    the road is straight in the recording's coordinates. Rates as in :class:`LaneChangeStatistics`.
    """

    name: str
    rows: int
    tracks: int
    seconds: float
    lanes: int
    lane_width_m: float
    nearest_lane_share: float
    vehicle_km: float
    mean_speed_mps: float
    lane_changes: int
    srlc: float
    per_vehicle_km: float
    per_vehicle_km_low: float
    per_vehicle_km_high: float


def summarise_scene(scene: Scene, exposure: Exposure, changes: LaneChanges, agreeing: float) -> SceneSummary:
    """Figures of ``scene``, given what was measured in it."""
    frame = scene.frame
    speed = float(frame["speed"].mean())  # type: ignore[arg-type]
    rates = lane_change_statistics(changes, exposure, speed)
    frames = int(frame["frame"].max() - frame["frame"].min()) + 1  # type: ignore[operator, arg-type]
    return SceneSummary(
        name=scene.name,
        rows=frame.height,
        tracks=exposure.tracks,
        seconds=round(0.1 * frames, 1),
        lanes=scene.lanes,
        lane_width_m=scene.lane_width_m,
        nearest_lane_share=agreeing,
        vehicle_km=exposure.vehicle_km,
        mean_speed_mps=speed,
        lane_changes=rates.count,
        srlc=rates.srlc,
        per_vehicle_km=rates.per_vehicle_km,
        per_vehicle_km_low=rates.per_vehicle_km_low,
        per_vehicle_km_high=rates.per_vehicle_km_high,
    )
