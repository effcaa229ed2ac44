"""Drivers who now and then err: all four faults laid over any traffic model."""

from __future__ import annotations

from ganlane.parameters.driving import IdmParameters, MobilParameters
from ganlane.parameters.traffic import DriverFaults
from ganlane.sim.idm import TABLE_V
from ganlane.sim.mobil import TABLE_IV
from ganlane.sim.random import Stream
from ganlane.sim.road import Road
from ganlane.sim.steering import STEERING, SteeringParameters
from ganlane.traffic.base import TrafficModule
from ganlane.traffic.faults import LateReaction, PhantomBraking
from ganlane.traffic.idm_mobil import IdmMobilTraffic
from ganlane.traffic.lane_change_faults import AbortedLaneChange, HesitantLaneChange
from ganlane.traffic.sequential import TrafficSequential


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
