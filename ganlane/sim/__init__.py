"""The simulator as pure functions on tensors (sections IV and V of the paper), without TorchRL.

A scene is a record of [N, M] tensors (:class:`Vehicles`: N environments, M vehicles). From it are
computed, in this order: which lanes each vehicle is in (:mod:`~ganlane.sim.state`) and whom its
driver sees (:mod:`~ganlane.sim.neighbours`), its acceleration (:mod:`~ganlane.sim.idm`), its lane
changes (:mod:`~ganlane.sim.mobil`), its steering and motion (:mod:`~ganlane.sim.dynamics`), and
collisions (:mod:`~ganlane.sim.collisions`). :mod:`~ganlane.sim.spawn` draws the initial scene of an
episode and keeps the road populated, :mod:`~ganlane.sim.scenes` and :mod:`~ganlane.sim.scenarios`
make scenes by hand, :mod:`~ganlane.sim.random` makes every random number.
"""

from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.dynamics import advance
from ganlane.sim.idm import following_acceleration
from ganlane.sim.mobil import safe_change
from ganlane.sim.neighbours import leader, perceive
from ganlane.sim.random import Purpose, Stream
from ganlane.sim.spawn import SpawnParameters
from ganlane.sim.state import Road, Vehicles, Visibility

__all__ = [
    "Purpose",
    "Road",
    "SpawnParameters",
    "Stream",
    "Vehicles",
    "Visibility",
    "advance",
    "following_acceleration",
    "leader",
    "pair_overlaps",
    "perceive",
    "safe_change",
]
