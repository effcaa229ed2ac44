"""Table III of the paper, entry by entry, as pure functions."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ganlane.parameters.observation import ObservationScale
from ganlane.sim.road import Road
from ganlane.sim.vehicles import Vehicles


class Others(NamedTuple):
    """The other vehicles as the ego sees them, each [N, M - 1], normalised and clipped to [-1, 1].

    Relative position, relative speed, lane difference (to the left is positive), whether there is one; and, which
    Table III does not have, where in its lane it is: 0 in the middle, 1 on the line to the left, -1 to the right; and
    how much of the distance to it lies within the two bodies, half of the ego's length plus half of its own, m.
    """

    position: Tensor
    speed: Tensor
    lane: Tensor
    valid: Tensor
    drift: Tensor
    bumpers_m: Tensor


def own_state(vehicles: Vehicles, road: Road) -> Tensor:
    """s1 to s3, [N, 3]: speed over desired speed (not clipped), a lane to the left, a lane to the right."""
    ego = vehicles.columns(slice(0, 1))
    lane = road.lane_of(ego.y)
    left = (lane < road.lanes - 1).to(ego.y.dtype)
    right = (lane > 0).to(ego.y.dtype)
    return torch.cat((ego.speed / ego.desired_speed, left, right), dim=1)


def other_vehicles(vehicles: Vehicles, road: Road, scale: ObservationScale) -> Others:
    """s4 and on, in the order of the vehicles' indices; one that is not valid reads (1, 0, 0), far ahead."""
    ego, others = vehicles.columns(slice(0, 1)), vehicles.columns(slice(1, None))
    position = (road.distance_ahead(ego.x, others.x) / scale.range_m).clamp(-1.0, 1.0)
    speed = ((others.speed - ego.speed) / scale.speed_mps).clamp(-1.0, 1.0)
    widest = road.lanes - 1 if isinstance(road.lanes, int) else (road.lanes - 1).to(speed.dtype)
    widest = max(widest, 1) if isinstance(widest, int) else widest.clamp_min(1)
    lane = ((road.lane_of(others.y) - road.lane_of(ego.y)) / widest).clamp(-1.0, 1.0)
    there = others.valid
    return Others(
        torch.where(there, position, 1.0),
        torch.where(there, speed, 0.0),
        torch.where(there, lane, 0.0),
        there,
        torch.where(there, drift_of(others.y, road), 0.0),
        torch.where(there, 0.5 * ego.length + 0.5 * others.length, 0.0),
    )


def drift_of(y: Tensor, road: Road) -> Tensor:
    """Distance to the left of the middle of one's lane over half of the lane's width, clipped to [-1, 1]."""
    off_m = y - road.centre_of(road.lane_of(y), y.dtype)
    return (2.0 * off_m / road.lane_width_m).clamp(-1.0, 1.0)


def nearest_first(others: Others, distance: Tensor) -> Others:
    """``others`` reordered by ``distance`` [N, M - 1], those that are not valid last."""
    order = torch.where(others.valid, distance, torch.inf).argsort(dim=1, stable=True)
    return Others(*(field.gather(1, order) for field in others))


def distance_to_ego(vehicles: Vehicles, road: Road) -> Tensor:
    """Distance along the road between the ego and each of the others, m, [N, M - 1]."""
    return road.distance_ahead(vehicles.x[:, :1], vehicles.x[:, 1:]).abs()


def as_list(others: Others) -> Tensor:
    """s4, s5, s6, s7, ...: three numbers per vehicle, [N, 3 (M - 1)]."""
    return torch.stack(others[:3], dim=-1).flatten(1)
