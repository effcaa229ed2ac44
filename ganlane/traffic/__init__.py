"""Traffic models: TensorDictModules that move the other vehicles, swappable by ``traffic=NAME``.

All follow one contract (:class:`TrafficModule`). :mod:`~ganlane.traffic.idm_mobil` is driven by rules,
:mod:`~ganlane.traffic.social_gan` by the generator. Overlays (:mod:`~ganlane.traffic.lane_change`,
:mod:`~ganlane.traffic.acceleration`) and the :mod:`~ganlane.traffic.guard` stand behind a base model in a
:class:`TrafficSequential`; :mod:`~ganlane.traffic.presets` builds the chains that ship.
"""

from ganlane.traffic.acceleration import AccelerationOverlay, SuddenAccelerations
from ganlane.traffic.base import TrafficModule
from ganlane.traffic.guard import Guard, GuardParameters
from ganlane.traffic.idm_mobil import IdmMobilTraffic, IdmTraffic
from ganlane.traffic.lane_change import (
    CalibratedChanges,
    CalibratedLaneChange,
    LiteralChanges,
    LiteralLaneChange,
)
from ganlane.traffic.sequential import Overlay, TrafficSequential

__all__ = [
    "AccelerationOverlay",
    "CalibratedChanges",
    "CalibratedLaneChange",
    "Guard",
    "GuardParameters",
    "IdmMobilTraffic",
    "IdmTraffic",
    "LiteralChanges",
    "LiteralLaneChange",
    "Overlay",
    "SuddenAccelerations",
    "TrafficModule",
    "TrafficSequential",
]
