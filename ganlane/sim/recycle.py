"""Vehicles that the ego has left behind return in front of it, and the reverse, so that the road never empties.

The ego sees ``range_m`` ahead and behind. A vehicle beyond that is moved by twice the range to the other side, as
if the road were a ring around the ego: lane, speed, driver and memory stay its own. It waits where it is until
there is room: nobody may have to brake harder than is safe because of it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ganlane.keys import EGO_INDEX
from ganlane.sim.idm import IdmParameters
from ganlane.sim.lanes import spanned
from ganlane.sim.mobil import prospect
from ganlane.sim.neighbours import Scene, perceive
from ganlane.sim.road import Road
from ganlane.sim.vehicles import Vehicles

#: The range of Table III's positions, m.
RANGE_M = 200.0
#: What nobody may have to exceed because of a vehicle that returns: MOBIL's safe deceleration, m/s2.
SAFE_DECELERATION = 4.0


def out_of_range(vehicles: Vehicles, road: Road, range_m: float = RANGE_M) -> Tensor:
    """Whether a vehicle is more than ``range_m`` ahead of the ego or behind it, bool [N, M]."""
    distance = road.distance_ahead(vehicles.x[:, EGO_INDEX, None], vehicles.x)
    return (distance.abs() > range_m) & vehicles.valid


def _room(scene: Scene, idm: IdmParameters, safe: float) -> Tensor:
    """Whether neither a vehicle nor a follower of it would have to brake harder than ``safe``, bool [N, M]."""
    seen = prospect(scene, spanned(scene.attention), idm)
    return (torch.minimum(seen.own, seen.with_it) >= -safe).all(-1)


def recycle(
    vehicles: Vehicles,
    road: Road,
    idm: IdmParameters,
    range_m: float = RANGE_M,
    safe_deceleration: float = SAFE_DECELERATION,
) -> Vehicles:
    """``vehicles`` with those out of range, for whom there is room, on the other side of the ego.

    The room is judged with all of them moved: who then has to wait leaves the others only more of it.
    """
    away = out_of_range(vehicles, road, range_m)
    distance = road.distance_ahead(vehicles.x[:, EGO_INDEX, None], vehicles.x)
    moved = vehicles.with_(x=torch.where(away, vehicles.x - 2.0 * range_m * torch.sign(distance), vehicles.x))
    room = _room(perceive(moved, road), idm, safe_deceleration)
    return vehicles.with_(x=torch.where(away & room, moved.x, vehicles.x))
