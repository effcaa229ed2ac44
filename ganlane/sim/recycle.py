"""Moves vehicles far behind the ego to far ahead of it, and the reverse, so that the road never empties.

A vehicle more than ``range_m`` from the ego is moved by twice the range to the other side, as if the road were a ring
around the ego; lane, speed, driver and internal state are kept. It is moved only when there is room, that is, when no
vehicle would have to brake harder than is safe because of it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ganlane.keys import EGO_INDEX
from ganlane.parameters.driving import IdmParameters
from ganlane.sim.idm import idm_acceleration
from ganlane.sim.neighbours import Scene, perceive
from ganlane.sim.state import Road, Vehicles, reads_are_cheap

#: Range of the positions in Table III, m.
RANGE_M = 200.0
#: Largest deceleration that a moved vehicle may require of any vehicle: MOBIL's safe deceleration, m/s2.
SAFE_DECELERATION = 4.0
#: Vehicles with less room than this between their sides count as being in one lane, m: who changes lanes drives at an
#: angle, and its corners reach further than its lanes say.
SIDE_M = 0.4


def out_of_range(vehicles: Vehicles, road: Road, range_m: float = RANGE_M) -> Tensor:
    """Whether a vehicle is more than ``range_m`` ahead of the ego or behind it, bool [N, M]."""
    distance = road.distance_ahead(vehicles.x[:, EGO_INDEX, None], vehicles.x)
    return (distance.abs() > range_m) & vehicles.valid


def _room(there: Scene, idm: IdmParameters, safe: float) -> Tensor:
    """Whether each of the first M vehicles requires no deceleration above ``safe`` in any pair, bool [N, M].

    ``there`` holds 2 M vehicles: all at their new positions, then all at their current ones. So the result holds
    whichever of the others move too.
    """
    count = there.observers.x.shape[1]
    low, high = (torch.cat((each, each), dim=1) for each in there.attention)
    shares = (there.attention.low[..., None] <= high[:, None, :]) & (
        low[:, None, :] <= there.attention.high[..., None]
    )
    own, other = there.observers, there.vehicles
    sides = 0.5 * own.width[..., None] + 0.5 * other.width[:, None, :] + SIDE_M
    shares |= (own.y[..., None] - other.y[:, None, :]).abs() < sides
    pairs = there.pairs
    itself = torch.eye(count, dtype=torch.bool, device=own.x.device).repeat(1, 2)
    counts = shares & other.valid[:, None, :] & ~itself
    speed, desired = own.speed[..., None], own.desired_speed[..., None]
    behind = idm_acceleration(speed, desired, pairs.ahead, other.speed[:, None, :], idm)
    before = idm_acceleration(other.speed[:, None, :], other.desired_speed[:, None, :], pairs.behind, speed, idm)
    asked = torch.where(pairs.order > 0, behind, before)
    return (~counts | (asked >= -safe)).all(-1)


def recycle(
    vehicles: Vehicles,
    road: Road,
    idm: IdmParameters,
    range_m: float = RANGE_M,
    safe_deceleration: float = SAFE_DECELERATION,
) -> Vehicles:
    """``vehicles`` with those out of range moved to the other side of the ego, where there is room.

    Room is tested against every other vehicle at its current *and* at its new position.
    """
    away = out_of_range(vehicles, road, range_m)
    if reads_are_cheap(away) and not bool(away.any()):
        return vehicles
    distance = road.distance_ahead(vehicles.x[:, EGO_INDEX, None], vehicles.x)
    moved = vehicles.with_(x=torch.where(away, vehicles.x - 2.0 * range_m * torch.sign(distance), vehicles.x))
    both = Vehicles(*(torch.cat(pair, dim=1) for pair in zip(moved, vehicles)))
    room = _room(perceive(both, road, slice(0, vehicles.x.shape[1])), idm, safe_deceleration)
    return vehicles.with_(x=torch.where(away & room, moved.x, vehicles.x))
