"""Traffic models: TensorDictModules that move the other vehicles, swappable by ``traffic=NAME``.

All follow one contract (:class:`TrafficModule`). :mod:`~ganlane.traffic.idm_mobil` is driven by rules,
:mod:`~ganlane.traffic.social_gan` and :mod:`~ganlane.traffic.calibrated_gan` by a generator (what the two share is
in :mod:`~ganlane.traffic.generated`); :mod:`~ganlane.traffic.replay` plays recordings, and in
:mod:`~ganlane.traffic.foreign` SUMO and HighwayEnv drive. Drivers of :mod:`~ganlane.traffic.idm_random` differ from
each other, :mod:`~ganlane.traffic.mixed` gives every episode to one of several models, and
:mod:`~ganlane.traffic.blind` hides the ego from any of them. Overlays
(:mod:`~ganlane.traffic.lane_change`, :mod:`~ganlane.traffic.acceleration`, and drivers' faults in
:mod:`~ganlane.traffic.faults` and :mod:`~ganlane.traffic.lane_change_faults`) and the
:mod:`~ganlane.traffic.guard` stand behind a base model in a :class:`TrafficSequential`;
:mod:`~ganlane.traffic.presets` builds the chains that ship, from what the weights say of their recordings
(:mod:`~ganlane.traffic.fitted`), and :mod:`~ganlane.traffic.driver_faults` the one of drivers who err.
"""

from ganlane.parameters.traffic import AbortFaults, BrakingFaults, HesitationFaults, RandomDrivers, ReactionFaults
from ganlane.traffic.acceleration import AccelerationOverlay, SuddenAccelerations
from ganlane.traffic.base import TrafficModule
from ganlane.traffic.blind import BlindTraffic
from ganlane.traffic.faults import LateReaction, PhantomBraking
from ganlane.traffic.foreign import HighwayEnvTraffic, SumoTraffic
from ganlane.traffic.guard import Guard, GuardParameters
from ganlane.traffic.idm_mobil import IdmMobilTraffic, IdmTraffic
from ganlane.traffic.idm_random import IdmRandomTraffic
from ganlane.traffic.lane_change import (
    CalibratedChanges,
    CalibratedLaneChange,
    LiteralChanges,
    LiteralLaneChange,
)
from ganlane.traffic.lane_change_faults import AbortedLaneChange, HesitantLaneChange
from ganlane.traffic.mixed import MixedTraffic
from ganlane.traffic.recordings import Recordings
from ganlane.traffic.replay import RecordedScenes, ReplayTraffic
from ganlane.traffic.sequential import Overlay, TrafficSequential

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
