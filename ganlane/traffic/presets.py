"""The chains that ship.

The paper's generated traffic, the calibrated one, and rule-driven drivers with faults.
"""

from __future__ import annotations

from typing import Any

from ganlane.generator.checkpoint import with_weights
from ganlane.generator.human import HumanPolicy
from ganlane.generator.networks import Generator
from ganlane.native.drivers import calibrated_drivers, gan_drivers, human_drivers
from ganlane.settings.driving import DriverFaults, IdmParameters, MobilParameters
from ganlane.settings.traffic import (
    GanCalibratedTrafficConfig,
    GanTrafficConfig,
    HumanTrafficConfig,
)
from ganlane.sim.dynamics import STEERING, SteeringParameters
from ganlane.sim.idm import TABLE_V
from ganlane.sim.mobil import TABLE_IV
from ganlane.sim.random import Stream
from ganlane.sim.state import Road
from ganlane.traffic.base import TrafficModule, TrafficSequential
from ganlane.traffic.faults import with_faults
from ganlane.traffic.human import HumanTraffic
from ganlane.traffic.idm_mobil import IdmMobilTraffic
from ganlane.traffic.overlays import (
    AccelerationOverlay,
    CalibratedLaneChange,
    Guard,
    LiteralLaneChange,
)
from ganlane.traffic.social_gan import AnchoredGanTraffic, SocialGanTraffic


def gan_traffic(
    road: Road | None = None,
    stream: int = Stream.TRAIN,
    idm: IdmParameters = TABLE_V,
    mobil: MobilParameters = TABLE_IV,
    **keys: Any,
) -> TrafficSequential:
    """``traffic=gan``, the paper's: positions only, literal blind lane changes, sudden
    accelerations.

    Args:
        road, stream: as for every traffic module.
        idm: of the guard's bounds on acceleration.
        mobil: how drivers leave a lane that ends.
        keys: those of :class:`~ganlane.settings.traffic.GanTrafficConfig`.

    Raises:
        UserError: the weights are missing, foreign or of the other preset.
    """
    drivers = gan_drivers(GanTrafficConfig(**keys), idm, stream)
    generator = with_weights(Generator, drivers.sizes, drivers.weights)
    # The order matters: a lane change moves sideways whatever the network did, and the guard bounds
    # the sum of all.
    parts: dict[str, TrafficModule] = {
        "generator": SocialGanTraffic(generator, drivers, road),
        "acceleration": AccelerationOverlay(road, stream, drivers.sudden),
        "lane_change": LiteralLaneChange(road, stream, drivers.changes, mobil),
    }
    # Last, so that nothing moves a vehicle after it.
    if drivers.guard is not None:
        parts["guard"] = Guard(road, stream, drivers.guard, idm)
    return TrafficSequential(parts, drivers)


def gan_calibrated_traffic(
    road: Road | None = None,
    stream: int = Stream.TRAIN,
    idm: IdmParameters = TABLE_V,
    mobil: MobilParameters = TABLE_IV,
    **keys: Any,
) -> TrafficSequential:
    """``traffic=gan_calibrated``: anchored residual, per-driver headways, checked lane changes at
    the recorded rate.

    Args:
        road, stream: as for every traffic module.
        idm: of the gap check; the anchor keeps its own (``SIMULATED_ANCHOR``).
        mobil: how drivers leave a lane that ends, and make room for those who have to.
        keys: those of :class:`~ganlane.settings.traffic.GanCalibratedTrafficConfig`.

    Raises:
        UserError: the weights are missing, foreign, of the other preset, or fitted without
            per-driver parameters.
    """
    drivers = calibrated_drivers(GanCalibratedTrafficConfig(**keys), idm, stream)
    generator = with_weights(Generator, drivers.sizes, drivers.weights)
    parts: dict[str, TrafficModule] = {
        "generator": AnchoredGanTraffic(generator, drivers, road, mobil),
        "lane_change": CalibratedLaneChange(road, stream, drivers.checked_changes, idm, mobil),
    }
    return TrafficSequential(parts, drivers)


def human_traffic(
    road: Road | None = None,
    stream: int = Stream.TRAIN,
    idm: IdmParameters = TABLE_V,
    mobil: MobilParameters = TABLE_IV,
    **keys: Any,
) -> HumanTraffic:
    """``traffic=human``: a policy fitted to recorded drivers (:mod:`ganlane.traffic.human`).

    Args:
        road, stream: as for every traffic module.
        idm: the ego's; also of drivers who make room.
        mobil: how drivers leave a lane that ends, and make room for those who have to.
        keys: those of :class:`~ganlane.settings.traffic.HumanTrafficConfig`.

    Raises:
        UserError: the weights are missing or foreign.
    """
    drivers = human_drivers(HumanTrafficConfig(**keys), idm, stream)
    policy = with_weights(HumanPolicy, drivers.sizes, drivers.weights)
    return HumanTraffic(policy, drivers, road, mobil)


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
