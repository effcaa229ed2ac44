"""The chains that ship: the paper's generated traffic, the calibrated one, and rule-driven drivers with faults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ganlane.data import DrivingStatistics
from ganlane.errors import UserError
from ganlane.generator import ANCHOR, AnchorParameters, headway_quantiles, load_generator, shipped_generator
from ganlane.parameters.driving import (
    CalibratedGanParameters,
    DriverFaults,
    GanParameters,
    IdmParameters,
    MobilParameters,
)
from ganlane.sim.dynamics import STEERING, SteeringParameters
from ganlane.sim.idm import TABLE_V
from ganlane.sim.mobil import TABLE_IV
from ganlane.sim.random import Stream
from ganlane.sim.state import Road
from ganlane.traffic.acceleration import AccelerationOverlay, SuddenAccelerations
from ganlane.traffic.base import TrafficModule, TrafficSequential
from ganlane.traffic.faults import with_faults
from ganlane.traffic.guard import Guard, GuardParameters
from ganlane.traffic.idm_mobil import IdmMobilTraffic
from ganlane.traffic.lane_change import CalibratedChanges, CalibratedLaneChange, LiteralChanges, LiteralLaneChange
from ganlane.traffic.social_gan import AnchoredGanTraffic, SocialGanTraffic

#: Anchor of the calibrated traffic: the fitted one, with brisker acceleration and lane changes as fast as recorded
#: ones.
SIMULATED_ANCHOR: AnchorParameters = replace(
    ANCHOR, idm=replace(ANCHOR.idm, max_acceleration=1.0), lane_stiffness=0.6, lane_damping=1.55
)
#: Wishes per executed lane change, measured in the simulation with 9 vehicles: a wish comes only while the driver is
#: near its lane's centre, and waiting for a gap costs distance. A slow test holds the resulting rate.
WISH_PER_CHANGE = 1.8


def literal_changes(statistics: DrivingStatistics, source: object) -> LiteralChanges:
    """Equations 9 to 11 with the numbers of all recordings given to the fit, held-out scenes too."""
    changes = statistics.lane_changes
    numbers = (changes.t_m_srlc_steps, changes.lateral_speed.mean, changes.lateral_speed.sd)
    if None in numbers:
        raise UserError(
            f"{source}: its recordings hold no complete lane change, so equations 9 to 11 have no numbers; "
            "fit the generator to recordings with lane changes."
        )
    mean_steps, speed, sd = (float(number) for number in numbers if number is not None)
    return LiteralChanges(mean_steps, speed, sd)


def sudden_accelerations(statistics: DrivingStatistics) -> SuddenAccelerations:
    """Gaussian of the recorded accelerations over one second, of all scenes."""
    recorded = statistics.acceleration_smoothed
    known = {name: getattr(recorded, name) for name in ("mean", "sd") if getattr(recorded, name) is not None}
    return SuddenAccelerations(**known)


def fitted_anchor(anchor: AnchorParameters, metadata: Mapping[str, Any], source: object) -> AnchorParameters:
    """``anchor`` with the washout and the further inputs that the weights were fitted with.

    By default those of :data:`ganlane.generator.ANCHOR`.

    Args:
        anchor: the anchor of the simulation.
        metadata: of the weights (:func:`ganlane.generator.load_generator`).
        source: their file, for the message.

    Raises:
        UserError: fitted without per-driver parameters, which this traffic always draws; or impossible values.
    """
    config = metadata["config"] if isinstance(metadata.get("config"), Mapping) else {}
    washout_s = config.get("washout_s", ANCHOR.washout_s)
    further_inputs = config.get("further_inputs", ANCHOR.further_inputs)
    if config.get("traits", True) is not True:
        raise UserError(
            f"{source}: fitted with traits={config['traits']}, but every driver of gan_calibrated has a headway "
            "and a desired speed of its own; give weights fitted with generator.traits=true."
        )
    # `not washout_s > 0` since NaN has to fail; `type` since True is no number of seconds.
    if type(washout_s) not in (int, float) or not washout_s > 0 or type(further_inputs) is not bool:
        raise UserError(
            f"{source}: its config says washout_s={washout_s!r} and further_inputs={further_inputs!r}, expected "
            "seconds above 0 and true or false; fit it again."
        )
    return replace(anchor, washout_s=float(washout_s), further_inputs=further_inputs)


def gan_traffic(
    road: Road | None = None,
    stream: int = Stream.TRAIN,
    path: str | Path | None = None,
    guard: bool = GanParameters.guard,
    noise_scale: float = GanParameters.noise_scale,
    execute_k: int = GanParameters.execute_k,
    idm: IdmParameters = TABLE_V,
) -> TrafficSequential:
    """``traffic=gan``, the paper's: positions only, literal blind lane changes, sudden accelerations.

    Args:
        road, stream: as for every traffic module.
        path: weights of the paper's preset; by default those that ship.
        guard: whether a guard follows; without it the closed loop drifts off.
        noise_scale: 1 samples trajectories as fitted, 0 takes the mean prediction.
        execute_k: predicted steps driven before predicting again (the paper: 1).
        idm: of the guard's bounds on acceleration.

    Raises:
        UserError: the weights are missing, foreign or of the other preset.
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
    """``traffic=gan_calibrated``: anchored residual, per-driver headways, checked lane changes at the recorded rate.

    Args:
        road, stream: as for every traffic module.
        path: weights of the calibrated preset; by default those that ship.
        noise_scale: of the latent vectors; 1 as fitted, 0 drives by the mean prediction.
        changes_per_km: hazard of wishing for a lane change; by default :data:`WISH_PER_CHANGE` times the recorded
            rate, which gives that rate in the simulation.
        noise_period_s: correlation time of a driver's latent vector.
        idm: of the gap check; the anchor keeps its own (:data:`SIMULATED_ANCHOR`).

    Raises:
        UserError: the weights are missing, foreign, of the other preset, or fitted without per-driver parameters.
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


def idm_faults_traffic(
    road: Road | None = None,
    stream: int = Stream.TRAIN,
    idm: IdmParameters = TABLE_V,
    mobil: MobilParameters = TABLE_IV,
    steering: SteeringParameters = STEERING,
    faults: DriverFaults | None = None,
) -> TrafficSequential:
    """``traffic=idm_faults``: ``idm_mobil`` with drivers' faults.

    Args:
        road, stream, idm, mobil, steering: as for :class:`ganlane.traffic.IdmMobilTraffic`.
        faults: rates, durations and sizes.
    """
    return with_faults(IdmMobilTraffic(road, stream, idm, steering, mobil), faults)
