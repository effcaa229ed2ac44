"""The chains that ship: the paper's generated traffic, the calibrated one, and rule-driven drivers with faults."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from ganlane.data import DrivingStatistics
from ganlane.generator import ANCHOR, AnchorParameters, headway_quantiles, load_generator, shipped_generator
from ganlane.parameters.driving import IdmParameters
from ganlane.parameters.traffic import CalibratedGanParameters, DriverFaults, GanParameters
from ganlane.sim.idm import TABLE_V
from ganlane.sim.random import Stream
from ganlane.sim.road import Road
from ganlane.traffic.acceleration import AccelerationOverlay
from ganlane.traffic.base import TrafficModule
from ganlane.traffic.calibrated_gan import AnchoredGanTraffic
from ganlane.traffic.driver_faults import idm_faults_traffic, with_faults
from ganlane.traffic.fitted import fitted_anchor, literal_changes, sudden_accelerations
from ganlane.traffic.guard import Guard, GuardParameters
from ganlane.traffic.lane_change import CalibratedChanges, CalibratedLaneChange, LiteralLaneChange
from ganlane.traffic.sequential import TrafficSequential
from ganlane.traffic.social_gan import SocialGanTraffic

__all__ = [
    "SIMULATED_ANCHOR",
    "WISH_PER_CHANGE",
    "DriverFaults",
    "gan_calibrated_traffic",
    "gan_traffic",
    "idm_faults_traffic",
    "with_faults",
]

#: Anchor of the calibrated traffic: the fitted one, but drivers pull away more briskly and move over as fast as
#: recorded ones do.
SIMULATED_ANCHOR: AnchorParameters = replace(
    ANCHOR, idm=replace(ANCHOR.idm, max_acceleration=1.0), lane_stiffness=0.6, lane_damping=1.55
)
#: Wishes per change that is carried out, measured in the simulation with 9 vehicles: a wish comes only while the
#: driver is near its lane's centre, and waiting for a gap costs distance. A slow test holds the rate that results.
WISH_PER_CHANGE = 1.8


def gan_traffic(
    road: Road | None = None,
    stream: int = Stream.TRAIN,
    path: str | Path | None = None,
    guard: bool = GanParameters.guard,
    noise_scale: float = GanParameters.noise_scale,
    execute_k: int = GanParameters.execute_k,
    idm: IdmParameters = TABLE_V,
) -> TrafficSequential:
    """``traffic=gan``, the paper's: positions only, literal lane changes that are blind, sudden accelerations.

    Args:
        road, stream: as for every traffic module.
        path: weights of the paper's preset; by default those that ship.
        guard: the guard behind it; without, the closed loop drifts off.
        noise_scale: 1 samples trajectories as fitted, 0 takes the mean prediction.
        execute_k: predicted steps that are driven before predicting again (the paper: 1).
        idm: of the guard's bounds on acceleration.

    Raises:
        UserError: the weights are absent, foreign or of the other preset.
    """
    source = path or shipped_generator("paper")
    generator, metadata = load_generator(source, "paper")
    statistics = DrivingStatistics.from_dict(metadata["driving_statistics"])
    parts: dict[str, TrafficModule] = {
        "generator": SocialGanTraffic(generator, road, stream, noise_scale=noise_scale, execute_k=execute_k),
        "acceleration": AccelerationOverlay(road, stream, sudden_accelerations(statistics)),
        "lane_change": LiteralLaneChange(road, stream, literal_changes(statistics, source)),
    }
    if guard:
        parts["guard"] = Guard(road, stream, GuardParameters(), idm)
    return TrafficSequential(parts)


def gan_calibrated_traffic(
    road: Road | None = None,
    stream: int = Stream.TRAIN,
    path: str | Path | None = None,
    noise_scale: float = CalibratedGanParameters.noise_scale,
    changes_per_km: float | None = None,
    noise_period_s: float = CalibratedGanParameters.noise_period_s,
    idm: IdmParameters = TABLE_V,
) -> TrafficSequential:
    """``traffic=gan_calibrated``: anchored residual, traits, lane changes behind a gap check at the recorded rate.

    The washout and the further inputs are those that the weights were fitted with
    (:func:`ganlane.traffic.fitted.fitted_anchor`).

    Args:
        road, stream: as for every traffic module.
        path: weights of the calibrated preset; by default those that ship.
        noise_scale: of the latent vectors; 1 as fitted, 0 drives everybody by the mean prediction.
        changes_per_km: hazard of wishing for a lane change; by default :data:`WISH_PER_CHANGE` times the rate of the
            recordings, which gives that rate in the simulation.
        noise_period_s: time in which a driver's latent vector is forgotten.
        idm: of the gap check; the anchor keeps its own (:data:`SIMULATED_ANCHOR`).

    Raises:
        UserError: the weights are absent, foreign, of the other preset, or fitted without traits.
    """
    source = path or shipped_generator("calibrated")
    generator, metadata = load_generator(source, "calibrated")
    statistics = DrivingStatistics.from_dict(metadata["driving_statistics"])
    recorded = statistics.lane_changes.per_vehicle_km or 0.0
    wishes = WISH_PER_CHANGE * recorded if changes_per_km is None else changes_per_km
    options: dict[str, Any] = {
        "noise_period_s": noise_period_s,
        "noise_scale": noise_scale,
        "headway_quantiles_s": headway_quantiles(metadata["driving_statistics"]),
        "anchor": fitted_anchor(SIMULATED_ANCHOR, metadata, source),
    }
    parts: dict[str, TrafficModule] = {
        "generator": AnchoredGanTraffic(generator, road, stream, **options),
        "lane_change": CalibratedLaneChange(road, stream, CalibratedChanges(wishes), idm),
    }
    return TrafficSequential(parts)
