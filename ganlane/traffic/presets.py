"""The chains that ship.

The paper's generated traffic, the calibrated one, and rule-driven drivers with faults.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ganlane.data import DrivingStatistics
from ganlane.errors import UserError
from ganlane.generator import (
    ANCHOR,
    AnchorParameters,
    headway_quantiles,
    load_generator,
    shipped_generator,
)
from ganlane.settings.driving import (
    DriverFaults,
    IdmParameters,
    MobilParameters,
)
from ganlane.settings.traffic import (
    GanCalibratedTrafficConfig,
    GanTrafficConfig,
)
from ganlane.sim.dynamics import STEERING, SteeringParameters
from ganlane.sim.idm import TABLE_V
from ganlane.sim.mobil import TABLE_IV
from ganlane.sim.random import Stream
from ganlane.sim.state import Road
from ganlane.traffic.base import TrafficModule, TrafficSequential
from ganlane.traffic.faults import with_faults
from ganlane.traffic.idm_mobil import IdmMobilTraffic
from ganlane.traffic.overlays import (
    AccelerationOverlay,
    CalibratedChanges,
    CalibratedLaneChange,
    Guard,
    GuardParameters,
    LiteralChanges,
    LiteralLaneChange,
    SuddenAccelerations,
)
from ganlane.traffic.social_gan import (
    AnchoredGanTraffic,
    SocialGanTraffic,
)

#: Anchor of the calibrated traffic: the fitted one, with brisker acceleration and lane changes as
#: fast as recorded ones.
SIMULATED_ANCHOR: AnchorParameters = replace(
    ANCHOR,
    idm=replace(ANCHOR.idm, max_acceleration=1.0),
    lane_stiffness=0.6,
    lane_damping=1.55,
)
#: Wishes per executed lane change, measured in the simulation with 9 vehicles: a wish comes only
#: while the driver is near its lane's centre, and waiting for a gap costs distance. A slow test
#: holds the resulting rate.
WISH_PER_CHANGE = 1.8


def literal_changes(statistics: DrivingStatistics, source: object) -> LiteralChanges:
    """Equations 9 to 11 with the numbers of all recordings given to the fit, held-out ones too."""
    changes = statistics.lane_changes
    numbers = (
        changes.t_m_srlc_steps,
        changes.lateral_speed.mean,
        changes.lateral_speed.sd,
    )
    # A number is missing if no change was recorded from beginning to end.
    if None in numbers:
        raise UserError(
            f"{source}: its recordings hold no complete lane change, so equations 9 to 11 have no "
            "numbers; fit the generator to recordings with lane changes."
        )
    # The condition is for type checkers; no number is None here.
    return LiteralChanges(*(float(number) for number in numbers if number is not None))


def sudden_accelerations(
    statistics: DrivingStatistics,
) -> SuddenAccelerations:
    """Gaussian of the recorded accelerations over one second, of all scenes."""
    recorded = statistics.acceleration_smoothed
    default = SuddenAccelerations()
    return SuddenAccelerations(
        # Where no acceleration was recorded these are None; 0 is a number.
        mean=default.mean if recorded.mean is None else recorded.mean,
        sd=default.sd if recorded.sd is None else recorded.sd,
    )


def fitted_anchor(metadata: Mapping[str, Any], source: object) -> AnchorParameters:
    """:data:`SIMULATED_ANCHOR` with the washout and the further inputs of the fit (by default those
    of ``ANCHOR``).

    Args:
        metadata, source: of the weights (:func:`ganlane.generator.load_generator`), and their file
            for messages.

    Raises:
        UserError: fitted without per-driver parameters, which this traffic always draws; or
            impossible values.
    """
    # A file may lack these entries: then the defaults of the fit hold.
    config = metadata["config"] if isinstance(metadata.get("config"), Mapping) else {}
    washout_s = config.get("washout_s", ANCHOR.washout_s)
    further_inputs = config.get("further_inputs", ANCHOR.further_inputs)
    if config.get("traits", True) is not True:
        raise UserError(
            f"{source}: fitted with traits={config['traits']}, but every driver of gan_calibrated "
            "has a headway and a desired speed of its own; give weights fitted with "
            "generator.traits=true."
        )
    # `not washout_s > 0` since NaN has to fail; `type` since True is no number of seconds.
    if type(washout_s) not in (int, float) or not washout_s > 0 or type(further_inputs) is not bool:
        raise UserError(
            f"{source}: its config says washout_s={washout_s!r} and "
            f"further_inputs={further_inputs!r}, expected seconds above 0 and true or false; fit "
            "it again."
        )
    return replace(
        SIMULATED_ANCHOR,
        washout_s=float(washout_s),
        further_inputs=further_inputs,
    )


def gan_traffic(
    road: Road | None = None,
    stream: int = Stream.TRAIN,
    path: str | Path | None = None,
    guard: bool = GanTrafficConfig.guard,
    noise_scale: float = GanTrafficConfig.noise_scale,
    execute_k: int = GanTrafficConfig.execute_k,
    idm: IdmParameters = TABLE_V,
) -> TrafficSequential:
    """``traffic=gan``, the paper's: positions only, literal blind lane changes, sudden
    accelerations.

    Args:
        road, stream: as for every traffic module.
        path, guard, noise_scale, execute_k: see
            :class:`~ganlane.settings.traffic.GanTrafficConfig`.
        idm: of the guard's bounds on acceleration.

    Raises:
        UserError: the weights are missing, foreign or of the other preset.
    """
    source = path or shipped_generator("paper")
    generator, metadata = load_generator(source, "paper")
    statistics = DrivingStatistics.from_dict(metadata["driving_statistics"])
    # The order matters: a lane change moves sideways whatever the network did, and the guard bounds
    # the sum of all.
    parts: dict[str, TrafficModule] = {
        "generator": SocialGanTraffic(
            generator,
            road,
            stream,
            noise_scale=noise_scale,
            execute_k=execute_k,
        ),
        "acceleration": AccelerationOverlay(road, stream, sudden_accelerations(statistics)),
        "lane_change": LiteralLaneChange(road, stream, literal_changes(statistics, source)),
    }
    # Last, so that nothing moves a vehicle after it.
    if guard:
        parts["guard"] = Guard(
            road,
            stream,
            GuardParameters(),
            idm,
        )
    return TrafficSequential(parts)


def gan_calibrated_traffic(
    road: Road | None = None,
    stream: int = Stream.TRAIN,
    path: str | Path | None = None,
    noise_scale: float = GanCalibratedTrafficConfig.noise_scale,
    changes_per_km: float | None = None,
    noise_period_s: float = GanCalibratedTrafficConfig.noise_period_s,
    idm: IdmParameters = TABLE_V,
) -> TrafficSequential:
    """``traffic=gan_calibrated``: anchored residual, per-driver headways, checked lane changes at
    the recorded rate.

    Args:
        road, stream: as for every traffic module.
        path, noise_scale, noise_period_s: see
            :class:`~ganlane.settings.traffic.GanCalibratedTrafficConfig`.
        changes_per_km: hazard of wishing for a lane change; by default :data:`WISH_PER_CHANGE`
            times the recorded rate, which gives that rate in the simulation.
        idm: of the gap check; the anchor keeps its own (:data:`SIMULATED_ANCHOR`).

    Raises:
        UserError: the weights are missing, foreign, of the other preset, or fitted without
            per-driver parameters.
    """
    source = path or shipped_generator("calibrated")
    generator, metadata = load_generator(source, "calibrated")
    statistics = DrivingStatistics.from_dict(metadata["driving_statistics"])
    # Without a recorded change nobody changes lanes.
    recorded = statistics.lane_changes.per_vehicle_km or 0.0
    # Only None asks for the recorded rate; 0 is a rate.
    wishes = WISH_PER_CHANGE * recorded if changes_per_km is None else changes_per_km
    headways_s = headway_quantiles(metadata["driving_statistics"])
    anchor = fitted_anchor(metadata, source)
    return TrafficSequential(
        {
            "generator": AnchoredGanTraffic(
                generator,
                road,
                stream,
                noise_period_s,
                noise_scale,
                headways_s,
                anchor,
            ),
            "lane_change": CalibratedLaneChange(road, stream, CalibratedChanges(wishes), idm),
        }
    )


def idm_faults_traffic(
    road: Road | None = None,
    stream: int = Stream.TRAIN,
    idm: IdmParameters = TABLE_V,
    mobil: MobilParameters = TABLE_IV,
    steering: SteeringParameters = STEERING,
    faults: DriverFaults | None = None,
) -> TrafficSequential:
    """``traffic=idm_faults``: :class:`ganlane.traffic.IdmMobilTraffic` with drivers' ``faults``."""
    return with_faults(IdmMobilTraffic(road, stream, idm, steering, mobil), faults)
