"""Traffic models: TensorDictModules that move the other vehicles, swappable by ``traffic=NAME``.

All follow one contract (:class:`TrafficModule`). :mod:`~ganlane.traffic.idm_mobil` is driven by
rules, :mod:`~ganlane.traffic.social_gan` by a generator; :mod:`~ganlane.traffic.replay` plays
recordings. :mod:`~ganlane.traffic.mixed` chooses a model per episode, or hides the ego. Overlays
(:mod:`~ganlane.traffic.overlays`, :mod:`~ganlane.traffic.faults`) follow a base model in a
:class:`TrafficSequential`; :mod:`~ganlane.traffic.presets` builds the chains that ship.

Traffic of foreign simulators is the package :mod:`ganlane_simulators`.
"""

from ganlane.traffic.base import Overlay, TrafficModule, TrafficSequential
from ganlane.traffic.faults import (
    AbortedLaneChange,
    HesitantLaneChange,
    LateReaction,
    PhantomBraking,
)
from ganlane.traffic.idm_mobil import IdmMobilTraffic, IdmRandomTraffic, IdmTraffic
from ganlane.traffic.mixed import BlindTraffic, MixedTraffic
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
from ganlane.traffic.replay import ReplayTraffic

__all__ = [
    "AbortedLaneChange",
    "AccelerationOverlay",
    "BlindTraffic",
    "CalibratedChanges",
    "CalibratedLaneChange",
    "Guard",
    "GuardParameters",
    "HesitantLaneChange",
    "IdmMobilTraffic",
    "IdmRandomTraffic",
    "IdmTraffic",
    "LateReaction",
    "LiteralChanges",
    "LiteralLaneChange",
    "MixedTraffic",
    "Overlay",
    "PhantomBraking",
    "ReplayTraffic",
    "SuddenAccelerations",
    "TrafficModule",
    "TrafficSequential",
]
