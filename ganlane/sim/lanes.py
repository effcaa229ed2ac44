"""Which lanes a vehicle occupies: as seen by others, and by its own driver.

When others see a lane change strongly affects the number of crashes, so it is a property of each vehicle:

- ``CENTRE``: only in the lane of its centre;
- ``BODY``: in every lane that its body enters by more than :data:`ENTRY_M`;
- ``SIGNALLED``: as ``BODY``, and in its target lane from the start of the change on.

The driver of a vehicle always attends to the lanes of its body *and* to its target lane.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ganlane.parameters.driving import Visibility
from ganlane.sim.state import Road, Vehicles, reads_are_cheap

ENTRY_M = 0.1
#: In an initial scene: the traffic sets a :class:`Visibility` per episode.
VISIBILITY_OF_EPISODE = -1
#: A lane change is complete, and the next one possible, within this distance of the target lane's centre.
ARRIVED_M = 0.3


class LaneRange(NamedTuple):
    """Lowest and highest lane of each vehicle, float tensors [N, M]."""

    low: Tensor
    high: Tensor

    def columns(self, which: slice) -> LaneRange:
        """The ranges of a slice of the vehicles."""
        return self if which == slice(None) else LaneRange(self.low[:, which], self.high[:, which])


def spanned(lanes: LaneRange) -> Tensor:
    """The lanes of a range, [..., 3]: lowest, middle and highest; [..., 2] or [..., 1] where that is seen to suffice.

    A vehicle at an angle can be in three lanes, if lanes are narrow, vehicles long or changes consecutive.
    """
    if reads_are_cheap(lanes.low) and (most := int((lanes.high - lanes.low).amax())) < 2:
        return torch.stack(lanes[: most + 1], dim=-1)
    return torch.stack((lanes.low, torch.minimum(lanes.low + 1, lanes.high), lanes.high), dim=-1)


def lateral_half_extent(vehicles: Vehicles) -> Tensor:
    """Half of the lateral space that each body takes at its heading, m."""
    return 0.5 * (vehicles.width * torch.cos(vehicles.heading) + vehicles.length * torch.sin(vehicles.heading).abs())


def body_lanes(vehicles: Vehicles, road: Road) -> LaneRange:
    """Lanes that each body enters by more than :data:`ENTRY_M`."""
    reach = lateral_half_extent(vehicles) - ENTRY_M
    edges = torch.stack((vehicles.y - reach, vehicles.y + reach))
    return LaneRange(*road.lane_of(edges).unbind())


def with_target(lanes: LaneRange, vehicles: Vehicles) -> LaneRange:
    """``lanes`` extended to the target lane: the lanes that the driver attends to."""
    target = vehicles.target_lane.to(lanes.low.dtype)
    return LaneRange(torch.minimum(lanes.low, target), torch.maximum(lanes.high, target))


def presence(vehicles: Vehicles, road: Road, body: LaneRange, attention: LaneRange) -> LaneRange:
    """Lanes in which others see each vehicle, by its visibility; an empty range for invalid vehicles."""
    centre = road.lane_of(vehicles.y)
    signalled = vehicles.visibility == int(Visibility.SIGNALLED)
    by_body = vehicles.visibility == int(Visibility.BODY)
    low = torch.where(signalled, attention.low, torch.where(by_body, body.low, centre))
    high = torch.where(signalled, attention.high, torch.where(by_body, body.high, centre))
    nowhere = torch.inf
    return LaneRange(torch.where(vehicles.valid, low, nowhere), torch.where(vehicles.valid, high, -nowhere))


def lane_change_done(vehicles: Vehicles, road: Road) -> Tensor:
    """Whether the lane change is done: centre within :data:`ARRIVED_M` of the target lane's centre, bool."""
    centre = road.centre_of(vehicles.target_lane, vehicles.y.dtype)
    return (vehicles.y - centre).abs() < ARRIVED_M
