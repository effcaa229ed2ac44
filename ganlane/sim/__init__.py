"""The simulator as pure functions on tensors (sections IV and V of the paper), without TorchRL.

A scene is a record of [N, M] tensors (:class:`Vehicles`: N environments, M vehicles). From it are
computed, in this order: which lanes each vehicle is in (:mod:`~ganlane.sim.state`) and whom its
driver sees (:mod:`~ganlane.sim.neighbours`), its acceleration (:mod:`~ganlane.sim.idm`), its lane
changes (:mod:`~ganlane.sim.mobil`), its steering and motion (:mod:`~ganlane.sim.dynamics`), and
collisions (:mod:`~ganlane.sim.collisions`). :mod:`~ganlane.sim.spawn` draws the initial scene of an
episode and keeps the road populated, :mod:`~ganlane.sim.scenes` and :mod:`~ganlane.sim.scenarios`
make scenes by hand, :mod:`~ganlane.sim.random` makes every random number.
"""

from ganlane.sim.collisions import boxes_overlap, dangerously_close, ego_overlaps, pair_overlaps
from ganlane.sim.dynamics import advance, steer
from ganlane.sim.idm import (
    TABLE_V,
    IdmParameters,
    equilibrium_gap,
    following_acceleration,
    idm_acceleration,
)
from ganlane.sim.mobil import TABLE_IV, MobilParameters, mobil_changes, safe_change
from ganlane.sim.neighbours import FREE_GAP_M, Scene, follower, leader, perceive
from ganlane.sim.random import Purpose, Stream, episode_key
from ganlane.sim.spawn import TABLE_II, SpawnParameters, recycle, spawn
from ganlane.sim.state import Road, Vehicles, Visibility

__all__ = [
    "FREE_GAP_M",
    "TABLE_II",
    "TABLE_IV",
    "TABLE_V",
    "IdmParameters",
    "MobilParameters",
    "Purpose",
    "Road",
    "Scene",
    "SpawnParameters",
    "Stream",
    "Vehicles",
    "Visibility",
    "advance",
    "boxes_overlap",
    "dangerously_close",
    "ego_overlaps",
    "episode_key",
    "equilibrium_gap",
    "follower",
    "following_acceleration",
    "idm_acceleration",
    "leader",
    "mobil_changes",
    "pair_overlaps",
    "perceive",
    "recycle",
    "safe_change",
    "spawn",
    "steer",
]
