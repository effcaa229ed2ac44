"""Whom the ego hit, on which side, and who moved into whom."""

from __future__ import annotations

import torch
from torch import Tensor

from ganlane.sim.collisions import ego_overlaps
from ganlane.sim.state import STRAIGHT, Road, Vehicles

#: Where the other vehicle of a crash was, by the numbers that :func:`contact_side` gives.
SIDES = ("none", "ahead", "side", "behind")
_AHEAD, _SIDE, _BEHIND = 1, 2, 3


def contact_side(vehicles: Vehicles, road: Road = STRAIGHT) -> Tensor:
    """What the ego overlaps: 0 nobody, 1 somebody ahead, 2 at the side, 3 behind (:data:`SIDES`), [N] int64.

    Two bodies meet along the axis on which their extents began to overlap last; the time since then is the depth of
    the overlap over the closing speed. Headings are small, so the axes are those of the road. Of several vehicles
    hit in one physics step the nearest to the front counts.
    """
    nobody = len(SIDES)
    first = torch.where(ego_overlaps(vehicles, road), _sides(vehicles, road), nobody).amin(-1)
    return torch.where(first == nobody, 0, first)


def ego_at_fault(vehicles: Vehicles, road: Road = STRAIGHT) -> Tensor:
    """Whether the ego moved into somebody, [N] bool; false where it hit nobody.

    Along the road whoever is behind moves into the other, across it whoever is faster towards the other: a rule of
    geometry, no law. A driver that cuts in and is struck from behind is not at fault by it.
    """
    v = vehicles
    side, dy = _sides(v, road), v.y[:, 1:] - v.y[:, :1]
    across = v.speed * torch.sin(v.heading)
    pushes = torch.sign(dy) * across[:, :1] > -torch.sign(dy) * across[:, 1:]
    own = torch.where(side == _SIDE, pushes, side == _AHEAD)
    return (own & ego_overlaps(v, road)).any(-1)


def _sides(v: Vehicles, road: Road) -> Tensor:
    """On which side of the ego each of the others would have met it, [N, M - 1] int64."""
    dx, dy = road.distance_ahead(v.x[:, :1], v.x[:, 1:]), v.y[:, 1:] - v.y[:, :1]
    along, across = v.speed * torch.cos(v.heading), v.speed * torch.sin(v.heading)
    met_along = _time_since(dx, along[:, 1:] - along[:, :1], 0.5 * (v.length[:, 1:] + v.length[:, :1]))
    met_across = _time_since(dy, across[:, 1:] - across[:, :1], 0.5 * (v.width[:, 1:] + v.width[:, :1]))
    return torch.where(met_along < met_across, torch.where(dx > 0, _AHEAD, _BEHIND), _SIDE)


def _time_since(distance: Tensor, speed: Tensor, reach: Tensor) -> Tensor:
    """For how long (s) extents that touch at ``reach`` (m) overlap; infinite where they do not close."""
    closing = -torch.sign(distance) * speed
    return torch.where(closing > 0, (reach - distance.abs()) / closing.clamp_min(1e-9), torch.inf)
