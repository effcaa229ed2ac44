"""The chains that ship.

The paper's generated traffic, the calibrated one, and rule-driven drivers with faults.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ganlane.generator import Generator, load_generator, load_human, shipped_generator
from ganlane.native.drivers import (
    FittedGenerator,
    calibrated_drivers,
    human_drivers,
    paper_drivers,
)
from ganlane.settings.driving import (
    DriverFaults,
    HumanVariation,
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
from ganlane.traffic.human import HumanTraffic
from ganlane.traffic.idm_mobil import IdmMobilTraffic
from ganlane.traffic.overlays import (
    AccelerationOverlay,
    CalibratedLaneChange,
    Guard,
    LiteralLaneChange,
)
from ganlane.traffic.social_gan import (
    AnchoredGanTraffic,
    SocialGanTraffic,
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
    config = GanTrafficConfig(guard=guard, noise_scale=noise_scale, execute_k=execute_k)
    drivers = paper_drivers(
        _fitted(generator, metadata, source),
        config,
        idm,
        stream,
    )
    # The order matters: a lane change moves sideways whatever the network did, and the guard bounds
    # the sum of all.
    parts: dict[str, TrafficModule] = {
        "generator": SocialGanTraffic(
            generator,
            road,
            stream,
            drivers.noise_period_s,
            noise_scale,
            execute_k,
        ),
        "acceleration": AccelerationOverlay(road, stream, drivers.sudden),
        "lane_change": LiteralLaneChange(road, stream, drivers.changes),
    }
    # Last, so that nothing moves a vehicle after it.
    if drivers.guard is not None:
        parts["guard"] = Guard(
            road,
            stream,
            drivers.guard,
            idm,
        )
    # The kernel drives no plans.
    return TrafficSequential(parts, drivers if execute_k == 1 else None)


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
        changes_per_km: hazard of wishing for a lane change; by default the recorded rate
            times ``WISH_PER_CHANGE``, which gives that rate in the simulation.
        idm: of the gap check; the anchor keeps its own (``SIMULATED_ANCHOR``).

    Raises:
        UserError: the weights are missing, foreign, of the other preset, or fitted without
            per-driver parameters.
    """
    source = path or shipped_generator("calibrated")
    generator, metadata = load_generator(source, "calibrated")
    config = GanCalibratedTrafficConfig(
        noise_scale=noise_scale,
        noise_period_s=noise_period_s,
        changes_per_km=changes_per_km,
    )
    drivers = calibrated_drivers(
        _fitted(generator, metadata, source),
        config,
        idm,
        stream,
    )
    assert drivers.anchor is not None
    parts: dict[str, TrafficModule] = {
        "generator": AnchoredGanTraffic(
            generator,
            road,
            stream,
            noise_period_s,
            noise_scale,
            drivers.headways_s,
            drivers.anchor,
        ),
        "lane_change": CalibratedLaneChange(road, stream, drivers.checked_changes, idm),
    }
    return TrafficSequential(parts, drivers)


def human_traffic(
    road: Road | None = None,
    stream: int = Stream.TRAIN,
    path: str | Path | None = None,
    variation: HumanVariation | None = None,
    idm: IdmParameters = TABLE_V,
) -> HumanTraffic:
    """``traffic=human``: a policy fitted to recorded drivers (:mod:`ganlane.traffic.human`).

    Args:
        road, stream: as for every traffic module.
        path: see :class:`~ganlane.settings.traffic.HumanTrafficConfig`.
        variation: how they differ from the fitted ones.
        idm: the ego's, where the kernel drives.

    Raises:
        UserError: the weights are missing or foreign.
    """
    source = path or shipped_generator("human")
    model, _ = load_human(source)
    weights = {name: tensor.numpy() for name, tensor in model.state_dict().items()}
    variation = variation or HumanVariation()
    drivers = human_drivers(weights, model.sizes, variation, idm, stream, source)
    return HumanTraffic(model.policy, road, stream, variation, drivers)


def _fitted(generator: Generator, metadata: Mapping[str, Any], source: object) -> FittedGenerator:
    """The generator as the kernel takes it."""
    weights = {name: tensor.numpy() for name, tensor in generator.state_dict().items()}
    return FittedGenerator(weights, generator.sizes, metadata, source)


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
