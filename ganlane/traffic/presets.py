"""The chains that ship: the paper's generated traffic, the calibrated one, and rule-driven drivers with faults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ganlane.data import DrivingStatistics
from ganlane.errors import UserError
from ganlane.generator import ANCHOR, AnchorParameters, headway_quantiles, load_generator, shipped_generator
from ganlane.sim.idm import TABLE_V, IdmParameters
from ganlane.sim.mobil import TABLE_IV, MobilParameters
from ganlane.sim.random import Stream
from ganlane.sim.road import Road
from ganlane.sim.steering import STEERING, SteeringParameters
from ganlane.traffic.acceleration import AccelerationOverlay, SuddenAccelerations
from ganlane.traffic.base import TrafficModule
from ganlane.traffic.faults import BrakingFaults, LateReaction, PhantomBraking, ReactionFaults
from ganlane.traffic.guard import Guard, GuardParameters
from ganlane.traffic.idm_mobil import IdmMobilTraffic
from ganlane.traffic.lane_change import (
    CalibratedChanges,
    CalibratedLaneChange,
    LiteralChanges,
    LiteralLaneChange,
)
from ganlane.traffic.lane_change_faults import (
    AbortedLaneChange,
    AbortFaults,
    HesitantLaneChange,
    HesitationFaults,
)
from ganlane.traffic.sequential import TrafficSequential
from ganlane.traffic.social_gan import AnchoredGanTraffic, SocialGanTraffic

#: Latent vectors of the calibrated traffic: so many times as large as in fitting, and forgotten so fast, s. Both were
#: chosen on the scenes that the generator is fitted to: as fitted (1 and 5 s) too few drivers accelerate.
NOISE_SCALE, NOISE_PERIOD_S = 1.4, 3.0
#: Its anchor: the fitted one, but drivers pull away more briskly and move over as fast as recorded ones do.
SIMULATED_ANCHOR: AnchorParameters = replace(
    ANCHOR, idm=replace(ANCHOR.idm, max_acceleration=1.0), lane_stiffness=0.6, lane_damping=1.55
)


def literal_changes(statistics: DrivingStatistics, source: object) -> LiteralChanges:
    """Equations 9 to 11 with the numbers of all recordings that were given to the fit, held-out scenes too."""
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
    told = {name: getattr(recorded, name) for name in ("mean", "sd") if getattr(recorded, name) is not None}
    return SuddenAccelerations(**told)


def simulated_anchor(metadata: Mapping[str, Any], source: object) -> AnchorParameters:
    """:data:`SIMULATED_ANCHOR` with the washout and the further inputs that the weights were fitted with.

    Weights whose metadata names neither were fitted with those of :data:`ganlane.generator.ANCHOR`.

    Args:
        metadata: of the weights (:func:`ganlane.generator.load_generator`).
        source: their file, for the message.

    Raises:
        UserError: fitted without traits, which this traffic always draws; or values that no fit can have.
    """
    config = metadata["config"] if isinstance(metadata.get("config"), Mapping) else {}
    washout_s = config.get("washout_s", ANCHOR.washout_s)
    further_inputs = config.get("further_inputs", ANCHOR.further_inputs)
    if config.get("traits", True) is not True:
        raise UserError(
            f"{source}: fitted with traits={config['traits']}, but every driver of gan_calibrated has a headway "
            "and a desired speed of its own; give weights fitted with generator.traits=true."
        )
    # Not in one comparison with 0: NaN has to fail, and True is no number of seconds.
    if type(washout_s) not in (int, float) or not washout_s > 0 or type(further_inputs) is not bool:
        raise UserError(
            f"{source}: its config says washout_s={washout_s!r} and further_inputs={further_inputs!r}, expected "
            "seconds above 0 and true or false; fit it again."
        )
    return replace(SIMULATED_ANCHOR, washout_s=float(washout_s), further_inputs=further_inputs)


def gan_traffic(
    road: Road | None = None,
    stream: int = Stream.TRAIN,
    path: str | Path | None = None,
    guard: bool = True,
    noise_scale: float = 1.0,
    execute_k: int = 1,
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
    noise_scale: float = NOISE_SCALE,
    changes_per_km: float | None = None,
    noise_period_s: float = NOISE_PERIOD_S,
    idm: IdmParameters = TABLE_V,
) -> TrafficSequential:
    """``traffic=gan_calibrated``: anchored residual, traits, lane changes behind a gap check at the recorded rate.

    The washout and the further inputs are those that the weights were fitted with (:func:`simulated_anchor`).

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
        "anchor": simulated_anchor(metadata, source),
    }
    parts: dict[str, TrafficModule] = {
        "generator": AnchoredGanTraffic(generator, road, stream, **options),
        "lane_change": CalibratedLaneChange(road, stream, CalibratedChanges(wishes), idm),
    }
    return TrafficSequential(parts)


#: Wishes per change that is carried out, measured in the simulation with 9 vehicles: a wish comes only while the
#: driver is near its lane's centre, and waiting for a gap costs distance. A slow test holds the rate that results.
WISH_PER_CHANGE = 1.8


@dataclass(frozen=True)
class DriverFaults:
    """How often drivers make which faults; a rate or share of 0 switches one off."""

    phantom_braking: BrakingFaults = field(default_factory=BrakingFaults)
    late_reaction: ReactionFaults = field(default_factory=ReactionFaults)
    hesitant_change: HesitationFaults = field(default_factory=HesitationFaults)
    aborted_change: AbortFaults = field(default_factory=AbortFaults)


def with_faults(base: TrafficModule, faults: DriverFaults | None = None) -> TrafficSequential:
    """``base`` (any traffic model, a chain too) with all four faults laid over it.

    The braking comes after the late reactions, since it is no reaction and late for nobody.
    """
    faults, (road, stream) = faults or DriverFaults(), (base.road, base.stream)
    parts: dict[str, TrafficModule] = {
        "base": base,
        "late_reaction": LateReaction(road, stream, faults.late_reaction),
        "phantom_braking": PhantomBraking(road, stream, faults.phantom_braking),
        "hesitant_change": HesitantLaneChange(road, stream, faults.hesitant_change),
        "aborted_change": AbortedLaneChange(road, stream, faults.aborted_change),
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
    """``traffic=idm_faults``: ``idm_mobil`` driven by people who now and then err.

    Args:
        road, stream, idm, mobil, steering: as for :class:`ganlane.traffic.IdmMobilTraffic`.
        faults: how often, how long and how badly.
    """
    return with_faults(IdmMobilTraffic(road, stream, idm, steering, mobil), faults)
