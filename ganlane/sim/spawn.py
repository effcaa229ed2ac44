"""Initial scenes (section IV.A, Table II), built without a rejection loop."""

from __future__ import annotations

import torch
from torch import Tensor

from ganlane.errors import ParameterError
from ganlane.parameters.driving import IdmParameters, Visibility
from ganlane.parameters.episode import SpawnParameters
from ganlane.sim.braking import can_brake, highest_speed, least_gap
from ganlane.sim.idm import TABLE_V
from ganlane.sim.random import Purpose, draw_keys, uniform
from ganlane.sim.vehicles import Vehicles

#: Purposes of the draws for every vehicle, in the order of the columns.
_DRAWN: list[int] = [Purpose.SPAWN_POSITION, Purpose.SPAWN_SPEED, Purpose.SPAWN_DESIRED_SPEED, Purpose.SPAWN_TRUCK]
TABLE_II = SpawnParameters()


def check_start(parameters: SpawnParameters, vehicles: int, lanes: int, idm: IdmParameters = TABLE_V) -> None:
    """Raise :class:`ParameterError` if ``vehicles`` do not fit on ``lanes``, overlap, or cannot brake."""
    p = parameters
    if p.min_spacing_m <= p.length_m:
        raise ParameterError(
            f"{{min_spacing_m}}={p.min_spacing_m:g} is not above the vehicles' length of {p.length_m:g} m: they "
            "would overlap; choose a larger spacing."
        )
    capacity = p.lane_capacity()
    if vehicles > lanes * capacity:
        lorries = f", {{truck_length_m}}={p.truck_length_m:g}" if p.truck_share > 0 else ""
        raise ParameterError(
            f"{{vehicles}}={vehicles} do not fit: {lanes} lanes x {capacity} vehicles "
            f"({{spread_m}}={p.spread_m:g}, {{min_spacing_m}}={p.min_spacing_m:g}{lorries}) "
            f"hold {lanes * capacity}; use fewer vehicles, more lanes or a larger {{spread_m}}."
        )
    if vehicles > 1:
        for follower in p.worst_followers():
            _check_braking(p, *follower, idm)


def _check_braking(
    p: SpawnParameters, field: str, speed: float, leader: float, desired: float, idm: IdmParameters
) -> None:
    """The fastest vehicle must avoid the slowest leader, at the smallest gap, when it brakes at the limit.

    The gap does not depend on which vehicles are lorries (:attr:`SpawnParameters.spacing_m`).
    """
    gap = p.min_spacing_m - p.length_m
    if not can_brake(gap, speed, leader, desired, idm):
        spacing = p.length_m + least_gap(speed, leader, desired, idm)
        slower = highest_speed(gap, leader, desired, idm)
        raise ParameterError(
            f"{{min_spacing_m}}={p.min_spacing_m:g} is too little for {{{field}}} up to {speed:g} m/s: a gap "
            f"of {gap:g} m is too short to avoid a leader of {leader:g} m/s that brakes at "
            f"{{idm.min_acceleration}}={idm.min_acceleration:g} m/s2; raise {{min_spacing_m}} to {spacing:.1f} or "
            f"lower {{{field}}} to {slower:.1f}."
        )


def _rank(value: Tensor, same: Tensor | None = None) -> Tensor:
    """Rank of each by ``value`` [N, M] and then index, among those where ``same`` [N, M, M] is true."""
    index = torch.arange(value.shape[1], device=value.device)
    mine, other = value[:, :, None], value[:, None, :]
    before = (other < mine) | ((other == mine) & (index[None, :] < index[:, None]))
    return (before if same is None else before & same).sum(-1)


def draw_lanes(key: Tensor, vehicles: int, lanes: int, capacity: int) -> Tensor:
    """A random lane for each vehicle, [N, vehicles] int64, at most ``capacity`` in each.

    All places of all lanes are shuffled and the first ``vehicles`` of them taken.
    """
    places = _place_keys(key, lanes * capacity)
    return places.argsort(dim=1, stable=True)[:, :vehicles] // capacity


def _place_keys(key: Tensor, places: int) -> Tensor:
    return draw_keys(key, 0, places, [int(Purpose.SPAWN_LANE)])[..., 0]


def place_in_lanes(lane: Tensor, u: Tensor, spread_m: float, spacing_m: float) -> Tensor:
    """Positions in m, [N, M]: in a lane of k sorted uniforms on [0, spread - spacing (k - 1)] plus spacing * rank."""
    same = lane[:, :, None] == lane[:, None, :]
    count = same.sum(-1)
    room = spread_m - spacing_m * (count - 1)
    return u * room + spacing_m * _rank(u, same)


def ego_first(x: Tensor, lane: Tensor) -> tuple[Tensor, Tensor]:
    """Order by position, but with the vehicle of rank (M - 1) // 2, the ego, first; shift the ego to x = 0."""
    rank = _rank(x)
    order = torch.where(rank == (x.shape[1] - 1) // 2, -1, rank).argsort(dim=1)
    x, lane = x.gather(1, order), lane.gather(1, order)
    return x - x[:, :1], lane


def _between(u: Tensor, bounds: tuple[float, float]) -> Tensor:
    return bounds[0] + u * (bounds[1] - bounds[0])


def spawn(
    key: Tensor,
    vehicles: int,
    lanes: int,
    lane_width_m: float,
    parameters: SpawnParameters = TABLE_II,
    dtype: torch.dtype = torch.float32,
    ego_visibility: int = Visibility.BODY,
    others_visibility: int = Visibility.SIGNALLED,
) -> Vehicles:
    """A random scene per episode key [N]; the ego is at index 0, the others follow by position."""
    p = parameters
    u = uniform(key, 0, vehicles, _DRAWN, dtype)
    lane = draw_lanes(key, vehicles, lanes, p.lane_capacity())
    x, lane = ego_first(place_in_lanes(lane, u[..., 0], p.spread_m, p.spacing_m), lane)
    is_ego = torch.arange(vehicles, device=key.device) == 0
    speed = torch.where(x > 0, _between(u[..., 1], p.front_speed_mps), _between(u[..., 1], p.rear_speed_mps))
    speed = torch.where(is_ego, _between(u[..., 1], p.ego_speed_mps), speed)
    is_truck = (u[..., 3] < p.truck_share) & ~is_ego
    desired = torch.where(is_ego, p.ego_desired_speed_mps, _between(u[..., 2], p.desired_speed_mps))
    desired = torch.where(is_truck, _between(u[..., 2], p.truck_desired_speed_mps), desired)
    seen = torch.where(is_ego, int(ego_visibility), int(others_visibility))
    zero = torch.zeros_like(x)
    return Vehicles(
        x=x,
        y=lane.to(dtype) * lane_width_m,
        heading=zero,
        speed=speed,
        acceleration=zero,
        length=torch.where(is_truck, p.truck_length_m, zero + p.length_m),
        width=torch.where(is_truck, p.truck_width_m, zero + p.width_m),
        desired_speed=desired,
        target_lane=lane,
        visibility=seen.expand(x.shape).clone(),
        valid=torch.ones_like(lane, dtype=torch.bool),
    )
