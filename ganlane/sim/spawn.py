"""Random initial scenes (section IV.A, Table II), built without a rejection loop."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ganlane.errors import ParameterError, UserError
from ganlane.parameters.driving import IdmParameters, Visibility
from ganlane.parameters.episode import SpawnParameters
from ganlane.sim.feasibility import can_brake, highest_speed, least_gap
from ganlane.sim.idm import TABLE_V
from ganlane.sim.random import Purpose, draw_keys, uniform
from ganlane.sim.state import STRAIGHT, Road, Vehicles

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
    places = draw_keys(key, 0, lanes * capacity, [int(Purpose.SPAWN_LANE)])[..., 0]
    return places.argsort(dim=1, stable=True)[:, :vehicles] // capacity


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
    visibility = torch.where(is_ego, int(ego_visibility), int(others_visibility))
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
        visibility=visibility.expand(x.shape).clone(),
        valid=torch.ones_like(lane, dtype=torch.bool),
    )


@dataclass(frozen=True)
class RandomScenes:
    """Table II: random positions and speeds (:func:`ganlane.sim.spawn.spawn`)."""

    road: Road = STRAIGHT
    vehicles: int = 9
    parameters: SpawnParameters = TABLE_II
    ego_visibility: int = Visibility.BODY
    others_visibility: int = Visibility.SIGNALLED

    def check(self, road: Road, idm: IdmParameters) -> None:
        """See :func:`ganlane.sim.spawn.check_start`; the road must be the scene's, wide and long enough."""
        if isinstance(road.lanes, Tensor) or isinstance(road.lane_width_m, Tensor):
            return  # a road for each row: its vehicles come from recordings
        if road != self.road:
            raise UserError(
                f"scenes: laid out on {_described(self.road)}, the traffic drives on {_described(road)}; give both "
                "the same road."
            )
        check_start(self.parameters, self.vehicles, road.lanes, idm)
        self._check_room(road.lane_width_m, road.ring_m)

    @property
    def longest_m(self) -> float:
        """Length of the longest vehicle of all episodes, m."""
        return self.parameters.longest_m

    def _check_room(self, lane_width_m: float, ring_m: float | None) -> None:
        """Check the room side by side, and where a ring closes: there the last vehicle is the first one's leader."""
        p = self.parameters
        if lane_width_m <= p.widest_m:
            wide = "width_m" if p.width_m == p.widest_m else "truck_width_m"
            raise UserError(
                f"env.lane_width_m={lane_width_m:g}: expected more than env.{wide}={p.widest_m:g}, or vehicles in "
                "neighbouring lanes touch; widen the lanes."
            )
        if ring_m is not None and p.spread_m + p.spacing_m > ring_m:
            more = f" ({p.spacing_m:g} with lorries)" if p.spacing_m > p.min_spacing_m else ""
            raise UserError(
                f"ring_m={ring_m:g}: expected at least env.spread_m={p.spread_m:g} and env.min_spacing_m="
                f"{p.min_spacing_m:g}{more} together, or the first vehicles overlap the last; lengthen the ring "
                "or lower env.spread_m."
            )

    def __call__(self, key: Tensor, dtype: torch.dtype) -> Vehicles:
        """One random scene per key."""
        lanes, width = self.road.lanes, self.road.lane_width_m
        assert not isinstance(lanes, Tensor)
        assert not isinstance(width, Tensor)
        visibility = (self.ego_visibility, self.others_visibility)
        return spawn(key, self.vehicles, lanes, float(width), self.parameters, dtype, *visibility)


def _described(road: Road) -> str:
    shape = "a straight road" if road.ring_m is None else f"a ring of {road.ring_m:g} m"
    return f"{shape} of {road.lanes} lanes of {road.lane_width_m} m"
