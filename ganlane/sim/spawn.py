"""Initial scenes (section IV.A, Table II), built without a rejection loop."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ganlane.errors import UserError
from ganlane.sim.braking import can_brake, highest_speed, least_gap
from ganlane.sim.idm import TABLE_V, IdmParameters
from ganlane.sim.lanes import Visibility
from ganlane.sim.random import Purpose, draw_keys, uniform
from ganlane.sim.vehicles import Vehicles

#: Purposes of the draws for every vehicle, in the order of the columns.
_DRAWN: list[int] = [Purpose.SPAWN_POSITION, Purpose.SPAWN_SPEED, Purpose.SPAWN_DESIRED_SPEED, Purpose.SPAWN_TRUCK]
_SIZES = (
    "spread_m",
    "min_spacing_m",
    "length_m",
    "width_m",
    "ego_desired_speed_mps",
    "truck_length_m",
    "truck_width_m",
)
_DESIRED = ("desired_speed_mps", "truck_desired_speed_mps")


@dataclass(frozen=True)
class SpawnParameters:
    """Table II, extended by lorries. Distances in m, speeds in m/s, (low, high) ranges.

    ``min_spacing_m`` is centre to centre in a lane, between cars; it is larger by the extra length of lorries
    (:attr:`spacing_m`). Each vehicle but the ego is a lorry with probability ``truck_share``. The defaults: 12 m and
    2.5 m, the longest rigid lorry of Directive 96/53/EC and about its 2.55 m; desired speeds of 80 to 90 km/h, from
    Germany's limit for lorries to the speed limiter of Directive 92/6/EEC.
    """

    spread_m: float = 200.0
    min_spacing_m: float = 25.0
    front_speed_mps: tuple[float, float] = (10.0, 12.0)
    rear_speed_mps: tuple[float, float] = (15.0, 25.0)
    ego_speed_mps: tuple[float, float] = (10.0, 15.0)
    desired_speed_mps: tuple[float, float] = (18.0, 26.0)
    ego_desired_speed_mps: float = 25.0
    length_m: float = 4.5
    width_m: float = 2.5
    truck_share: float = 0.0
    truck_length_m: float = 12.0
    truck_width_m: float = 2.5
    truck_desired_speed_mps: tuple[float, float] = (22.0, 25.0)

    @property
    def longest_m(self) -> float:
        """Length of the longest possible vehicle, m."""
        return max(self.length_m, self.truck_length_m) if self.truck_share > 0 else self.length_m

    @property
    def widest_m(self) -> float:
        """Width of the widest possible vehicle, m."""
        return max(self.width_m, self.truck_width_m) if self.truck_share > 0 else self.width_m

    @property
    def spacing_m(self) -> float:
        """Minimum distance between centres in a lane, m: the gap between two lorries is that between two cars."""
        return self.min_spacing_m + (self.longest_m - self.length_m)

    def lane_capacity(self) -> int:
        """Vehicles that fit into one lane, whichever of them are lorries."""
        return int(self.spread_m / self.spacing_m) + 1

    def check(self, vehicles: int, lanes: int, idm: IdmParameters = TABLE_V) -> None:
        """Raise :class:`UserError` for impossible numbers, or if ``vehicles`` do not fit, overlap, or cannot
        brake."""
        self._check_sizes()
        self._check_speeds()
        if self.min_spacing_m <= self.length_m:
            raise UserError(
                f"env.min_spacing_m={self.min_spacing_m:g} is not above the vehicles' length of "
                f"{self.length_m:g} m: they would overlap; choose a larger spacing."
            )
        capacity = self.lane_capacity()
        if vehicles > lanes * capacity:
            raise UserError(
                f"env.vehicles={vehicles} do not fit: {lanes} lanes x {capacity} vehicles "
                f"(env.spread_m={self.spread_m:g}, env.min_spacing_m={self.min_spacing_m:g}{self._of_lorries()}) "
                f"hold {lanes * capacity}; use fewer vehicles, more lanes or a larger env.spread_m."
            )
        if vehicles > 1:
            for follower in self.worst_followers():
                self._check_braking(*follower, idm)

    def _of_lorries(self) -> str:
        return f", env.truck_length_m={self.truck_length_m:g}" if self.truck_share > 0 else ""

    def _check_sizes(self) -> None:
        for name in _SIZES:
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise UserError(f"env.{name}={value:g}: expected a finite number above 0; give one.")
        if not 0 <= self.truck_share <= 1:
            raise UserError(f"env.truck_share={self.truck_share:g}: expected a share from 0 to 1; give one.")

    def _check_speeds(self) -> None:
        for name in ("front_speed_mps", "rear_speed_mps", "ego_speed_mps", *_DESIRED):
            low, high = getattr(self, name)
            if not (math.isfinite(high) and 0 <= low <= high):
                raise UserError(
                    f"env.{name}=({low:g}, {high:g}): expected two finite speeds from 0 on, the lower one first; "
                    "give such a range."
                )
        for name in _DESIRED:
            low, high = getattr(self, name)
            if low <= 0:
                raise UserError(
                    f"env.{name}=({low:g}, {high:g}): expected speeds above 0, as IDM requires; raise the lower one."
                )

    def worst_followers(self) -> tuple[tuple[str, float, float, float], ...]:
        """Fastest followers: key, highest speed, the leader's lowest speed, highest desired speed, m/s."""
        front, rear, ego = self.front_speed_mps, self.rear_speed_mps, self.ego_speed_mps
        others = max(self.desired_speed_mps[1], self.truck_desired_speed_mps[1] if self.truck_share > 0 else 0.0)
        return (
            ("rear_speed_mps", rear[1], min(rear[0], ego[0], front[0]), others),
            ("ego_speed_mps", ego[1], front[0], self.ego_desired_speed_mps),
            ("front_speed_mps", front[1], front[0], others),
        )

    def _check_braking(self, key: str, speed: float, leader: float, desired: float, idm: IdmParameters) -> None:
        """The fastest vehicle must avoid the slowest leader, at the smallest gap, when it brakes at the limit.

        The gap does not depend on which vehicles are lorries (:attr:`spacing_m`).
        """
        gap = self.min_spacing_m - self.length_m
        if not can_brake(gap, speed, leader, desired, idm):
            spacing = self.length_m + least_gap(speed, leader, desired, idm)
            slower = highest_speed(gap, leader, desired, idm)
            raise UserError(
                f"env.min_spacing_m={self.min_spacing_m:g} is too little for env.{key} up to {speed:g} m/s: a gap "
                f"of {gap:g} m is too short to avoid a leader of {leader:g} m/s that brakes at "
                f"env.idm.min_acceleration={idm.min_acceleration:g} m/s2; raise env.min_spacing_m to {spacing:.1f} "
                f"or lower env.{key} to {slower:.1f}."
            )


TABLE_II = SpawnParameters()


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
