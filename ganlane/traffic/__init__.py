"""Traffic models: TensorDictModules that move the other vehicles, swappable by ``traffic=NAME``.

All follow one contract (:class:`TrafficModule`). :mod:`~ganlane.traffic.idm_mobil` is driven by rules, in
:mod:`~ganlane.traffic.idm_random` with individual drivers, :mod:`~ganlane.traffic.social_gan` by a generator;
:mod:`~ganlane.traffic.replay` plays recordings, and in :mod:`~ganlane.traffic.foreign` SUMO and HighwayEnv drive.
:mod:`~ganlane.traffic.mixed` chooses a model per episode, or hides the ego. Overlays
(:mod:`~ganlane.traffic.lane_change`, :mod:`~ganlane.traffic.acceleration`, :mod:`~ganlane.traffic.faults`) and the
:mod:`~ganlane.traffic.guard` follow a base model in a :class:`TrafficSequential`;
:mod:`~ganlane.traffic.presets` builds the chains that ship.
"""

from ganlane.parameters.driving import AbortFaults, BrakingFaults, HesitationFaults, RandomDrivers, ReactionFaults
from ganlane.traffic.acceleration import AccelerationOverlay, SuddenAccelerations
from ganlane.traffic.base import Overlay, TrafficModule, TrafficSequential
from ganlane.traffic.faults import AbortedLaneChange, HesitantLaneChange, LateReaction, PhantomBraking
from ganlane.traffic.foreign import HighwayEnvTraffic, SumoTraffic
from ganlane.traffic.guard import Guard, GuardParameters
from ganlane.traffic.idm_mobil import IdmMobilTraffic, IdmTraffic
from ganlane.traffic.idm_random import IdmRandomTraffic
from ganlane.traffic.lane_change import CalibratedChanges, CalibratedLaneChange, LiteralChanges, LiteralLaneChange
from ganlane.traffic.mixed import BlindTraffic, MixedTraffic
from ganlane.traffic.replay import RecordedScenes, Recordings, ReplayTraffic

__all__ = [
    "AbortFaults",
    "AbortedLaneChange",
    "AccelerationOverlay",
    "BlindTraffic",
    "BrakingFaults",
    "CalibratedChanges",
    "CalibratedLaneChange",
    "Guard",
    "GuardParameters",
    "HesitantLaneChange",
    "HesitationFaults",
    "HighwayEnvTraffic",
    "IdmMobilTraffic",
    "IdmRandomTraffic",
    "IdmTraffic",
    "LateReaction",
    "LiteralChanges",
    "LiteralLaneChange",
    "MixedTraffic",
    "Overlay",
    "PhantomBraking",
    "RandomDrivers",
    "ReactionFaults",
    "RecordedScenes",
    "Recordings",
    "ReplayTraffic",
    "SuddenAccelerations",
    "SumoTraffic",
    "TrafficModule",
    "TrafficSequential",
]
