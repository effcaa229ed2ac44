"""Who is on the road: random initial scenes (section IV.A, Table II), and vehicles that return.

A scene is built without a rejection loop. Recycling moves vehicles far behind the ego to far ahead
of it, and the reverse, so that the road never empties: one more than ``range_m`` from the ego is
moved by twice the range to the other side, as if the road were a ring around the ego; lane, speed,
driver and internal state are kept. It is moved only when there is room, that is, when no vehicle
would have to brake harder than is safe because of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ganlane.errors import ParameterError, UserError
from ganlane.keys import EGO_INDEX
from ganlane.settings.driving import IdmParameters, Visibility
from ganlane.settings.episode import SpawnParameters
from ganlane.sim.idm import (
    TABLE_V,
    can_brake,
    highest_speed,
    idm_acceleration,
    least_gap,
)
from ganlane.sim.neighbours import FREE_GAP_M, compare
from ganlane.sim.random import Purpose, draw_keys, in_range, uniform
from ganlane.sim.state import (
    STRAIGHT,
    LaneRange,
    Road,
    Vehicles,
    body_lanes,
    with_target,
)

TABLE_II = SpawnParameters()
#: Range of the positions in Table III, m.
RANGE_M = 200.0
#: Largest deceleration that a moved vehicle may require of any vehicle: MOBIL's safe deceleration,
#: m/s2.
SAFE_DECELERATION = 4.0
#: Vehicles with less room than this between their sides count as being in one lane, m: who changes
#: lanes drives at an angle, and its corners reach further than its lanes say.
SIDE_M = 0.4


def check_start(
    parameters: SpawnParameters,
    vehicles: int,
    lanes: int,
    idm: IdmParameters = TABLE_V,
) -> None:
    """Check that random scenes are possible and safe.

    Args:
        parameters: of the scenes.
        vehicles: M, the ego included.
        lanes: of the road.
        idm: how hard a follower can brake.

    Raises:
        ParameterError: the vehicles do not fit, overlap, or cannot brake in time.
    """
    p = parameters
    if p.min_spacing_m <= p.length_m:
        raise ParameterError(
            f"{{min_spacing_m}}={p.min_spacing_m:g} is not above the vehicles' length of "
            f"{p.length_m:g} m: they would overlap; choose a larger spacing."
        )

    capacity = p.lane_capacity()
    if vehicles > lanes * capacity:
        lorries = f", {{truck_length_m}}={p.truck_length_m:g}" if p.truck_share > 0 else ""
        raise ParameterError(
            f"{{vehicles}}={vehicles} do not fit: {lanes} lanes x {capacity} vehicles "
            f"({{spread_m}}={p.spread_m:g}, {{min_spacing_m}}={p.min_spacing_m:g}{lorries}) "
            f"hold {lanes * capacity}; use fewer vehicles, more lanes or a larger {{spread_m}}."
        )
    if vehicles < 2:
        # Nobody follows anybody.
        return

    # The fastest vehicle must avoid the slowest leader, at the smallest gap, when it brakes at the
    # limit. That gap is the same whichever vehicles are lorries (SpawnParameters.spacing_m).
    gap = p.min_spacing_m - p.length_m
    for field, speed, leader, desired in p.worst_followers():
        if can_brake(gap, speed, leader, desired, idm):
            continue
        spacing = p.length_m + least_gap(speed, leader, desired, idm)
        slower = highest_speed(gap, leader, desired, idm)
        raise ParameterError(
            f"{{min_spacing_m}}={p.min_spacing_m:g} is too little for {{{field}}} up to "
            f"{speed:g} m/s: a gap of {gap:g} m is too short to avoid a leader of {leader:g} "
            f"m/s that brakes at {{idm.min_acceleration}}={idm.min_acceleration:g} m/s2; raise "
            f"{{min_spacing_m}} to {spacing:.1f} or lower {{{field}}} to {slower:.1f}."
        )


def draw_lanes(key: Tensor, vehicles: int, lanes: int, capacity: int) -> Tensor:
    """A random lane for each vehicle, [N, vehicles] int64, at most ``capacity`` in each.

    All places of all lanes are shuffled and the first ``vehicles`` of them taken. ``key`` [N] int64
    is that of the episodes.
    """
    # A random key for every place; the lowest ones are taken.
    places = draw_keys(key, 0, lanes * capacity, [Purpose.SPAWN_LANE])[..., 0]
    shuffled = places.argsort(dim=1, stable=True)
    return shuffled[:, :vehicles] // capacity


def place_in_lanes(lane: Tensor, u: Tensor, spread_m: float, spacing_m: float) -> Tensor:
    """Positions in m, [N, M].

    In a lane of k sorted uniforms on [0, spread - spacing (k - 1)] plus spacing * rank.

    Args:
        lane: of each vehicle, [N, M].
        u: uniform numbers in [0, 1), [N, M].
        spread_m: length of the section in which they are placed, m.
        spacing_m: least distance of two in one lane, centre to centre, m.
    """
    # Sorted uniforms plus spacings: uniform among all placings that keep the spacing.
    same = lane[:, :, None] == lane[:, None, :]

    # In the run's float type: whole numbers times a float would be in torch's default one.
    count = same.sum(-1).to(u.dtype)
    room = spread_m - spacing_m * (count - 1)

    # By counting, not by sorting: a few vehicles, and a fixed order for equal values.
    index = torch.arange(u.shape[1], device=u.device)
    mine = u[:, :, None]
    other = u[:, None, :]
    # [N, i, j]: j is placed before i.
    before = (other < mine) | ((other == mine) & (index < index[:, None]))
    rank = (before & same).sum(-1).to(u.dtype)
    return u * room + spacing_m * rank


def ego_first(x: Tensor, lane: Tensor) -> tuple[Tensor, Tensor]:
    """``x``, m, and ``lane`` [N, M] in the order of position, but with the ego first, at x = 0.

    The ego is the vehicle of rank (M - 1) // 2.
    """
    # The vehicle in the middle becomes the ego, with as many ahead as behind.
    order = x.argsort(dim=1, stable=True)
    middle = (x.shape[1] - 1) // 2
    behind = order[:, :middle]
    ego = order[:, middle : middle + 1]
    ahead = order[:, middle + 1 :]
    order = torch.cat((ego, behind, ahead), dim=1)

    x = x.gather(1, order)
    lane = lane.gather(1, order)
    return x - x[:, :1], lane


@dataclass(frozen=True)
class RandomScenes:
    """Table II: random positions and speeds.

    Attributes:
        road: the same in all episodes, straight or a ring.
        vehicles: M, the ego included.
        parameters: ranges of the random numbers.
        ego_visibility, others_visibility: when others see a lane change, a :class:`Visibility`.
    """

    road: Road = STRAIGHT
    vehicles: int = 9
    parameters: SpawnParameters = TABLE_II
    ego_visibility: int = Visibility.BODY
    others_visibility: int = Visibility.SIGNALLED

    def check(self, road: Road, idm: IdmParameters) -> None:
        """See :func:`check_start`.

        The road must be the scene's, wide enough, and as a ring long enough.

        Raises:
            UserError: it is not, or the vehicles do not fit or could not brake in time.
        """
        p = self.parameters
        lane_width_m = road.lane_width_m
        ring_m = road.ring_m
        if isinstance(road.lanes, Tensor) or isinstance(lane_width_m, Tensor):
            # A road for each row: its vehicles come from recordings.
            return
        if road != self.road:
            raise UserError(
                f"scenes: laid out on {_described(self.road)}, the traffic drives on "
                f"{_described(road)}; give both the same road."
            )
        check_start(p, self.vehicles, road.lanes, idm)

        if lane_width_m <= p.widest_m:
            wide = "width_m" if p.width_m == p.widest_m else "truck_width_m"
            raise UserError(
                f"env.lane_width_m={lane_width_m:g}: expected more than env.{wide}="
                f"{p.widest_m:g}, or vehicles in neighbouring lanes touch; widen the lanes."
            )

        # Where a ring closes, the last vehicle is the first one's leader.
        if ring_m is not None and p.spread_m + p.spacing_m > ring_m:
            more = f" ({p.spacing_m:g} with lorries)" if p.spacing_m > p.min_spacing_m else ""
            raise UserError(
                f"ring_m={ring_m:g}: expected at least env.spread_m={p.spread_m:g} and "
                f"env.min_spacing_m={p.min_spacing_m:g}{more} together, or the first vehicles "
                "overlap the last; lengthen the ring or lower env.spread_m."
            )

    @property
    def longest_m(self) -> float:
        """Length of the longest vehicle of all episodes, m."""
        return self.parameters.longest_m

    def __call__(self, key: Tensor, dtype: torch.dtype) -> Vehicles:
        """One random scene per ``key`` [N] int64, fields [N, M].

        The ego is at index 0; the others follow by position, from the rearmost on.
        """
        p = self.parameters

        # Uniform numbers in [0, 1), [N, M] each.
        drawn = [
            Purpose.SPAWN_POSITION,
            Purpose.SPAWN_SPEED,
            Purpose.SPAWN_DESIRED_SPEED,
            Purpose.SPAWN_TRUCK,
        ]
        numbers = uniform(key, 0, self.vehicles, drawn, dtype)
        u_position, u_speed, u_desired, u_truck = numbers.unbind(-1)

        # Places, and who is the ego.
        lane = draw_lanes(key, self.vehicles, int(self.road.lanes), p.lane_capacity())
        x = place_in_lanes(lane, u_position, p.spread_m, p.spacing_m)
        x, lane = ego_first(x, lane)
        is_ego = torch.arange(self.vehicles, device=key.device) == 0

        # In Table II who is ahead of the ego is slower than who is behind it.
        ahead = in_range(u_speed, p.front_speed_mps)
        behind = in_range(u_speed, p.rear_speed_mps)
        speed = torch.where(x > 0, ahead, behind)
        ego_speed = in_range(u_speed, p.ego_speed_mps)
        speed = torch.where(is_ego, ego_speed, speed)

        # The ego is no lorry, and its desired speed is not drawn.
        is_truck = (u_truck < p.truck_share) & ~is_ego
        others = in_range(u_desired, p.desired_speed_mps)
        desired = torch.where(is_ego, p.ego_desired_speed_mps, others)
        trucks = in_range(u_desired, p.truck_desired_speed_mps)
        desired = torch.where(is_truck, trucks, desired)

        visibility = torch.where(is_ego, int(self.ego_visibility), int(self.others_visibility))
        zero = torch.zeros_like(x)

        return Vehicles(
            x=x,
            y=lane.to(dtype) * float(self.road.lane_width_m),
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


def _described(road: Road) -> str:
    """A road in words, for messages."""
    shape = "a straight road" if road.ring_m is None else f"a ring of {road.ring_m:g} m"
    return f"{shape} of {road.lanes} lanes of {road.lane_width_m} m"


# Recycling


def out_of_range(vehicles: Vehicles, road: Road) -> Tensor:
    """Whether a vehicle is more than :data:`RANGE_M` ahead of the ego or behind it, bool [N, M]."""
    distance = road.distance_ahead(vehicles.x[:, EGO_INDEX, None], vehicles.x)
    return (distance.abs() > RANGE_M) & vehicles.valid


def leave_room(
    one: Vehicles,
    other: Vehicles,
    lanes: tuple[LaneRange, LaneRange],
    distance: Tensor,
    ahead: Tensor,
    idm: IdmParameters,
) -> Tensor:
    """Whether of two vehicles neither makes the other brake harder than is safe, elementwise.

    Safe is :data:`SAFE_DECELERATION`; vehicles in different lanes do not make each other brake.

    Args:
        one, other: their fields broadcast with ``distance``.
        lanes: that the drivers of the two attend to.
        distance: from the centre of the one to that of the other, m.
        ahead: whether the other is ahead, bool.
        idm: by which they brake.
    """
    # Sharing a lane, or nearly touching sides.
    its, theirs = lanes
    shares = (its.low <= theirs.high) & (theirs.low <= its.high)
    sides = 0.5 * one.width + 0.5 * other.width + SIDE_M
    shares = shares | ((one.y - other.y).abs() < sides)

    # What the one behind the other has to do, from bumper to bumper.
    bumpers = 0.5 * one.length + 0.5 * other.length
    gap = (distance.abs() - bumpers).clamp_max(FREE_GAP_M)
    behind = idm_acceleration(one.speed, one.desired_speed, gap, other.speed, idm)
    before = idm_acceleration(other.speed, other.desired_speed, gap, one.speed, idm)
    asked = torch.where(ahead, behind, before)

    apart = ~(shares & other.valid)
    return apart | (asked >= -SAFE_DECELERATION)


def recycle(vehicles: Vehicles, road: Road, idm: IdmParameters) -> Vehicles:
    """``vehicles`` with those out of range moved to the other side of the ego, where there is room.

    Room is tested against every other vehicle at its current *and* at its new position, so it is
    there whichever of the others move too.
    """
    away = out_of_range(vehicles, road)

    # By twice the range, so that the distance to the ego only changes its sign.
    distance = road.distance_ahead(vehicles.x[:, EGO_INDEX, None], vehicles.x)
    across = vehicles.x - 2.0 * RANGE_M * torch.sign(distance)
    moved = vehicles.with_(x=torch.where(away, across, vehicles.x))

    # All at their new positions, then all at their current ones: [N, M] against [N, 2 M].
    both = Vehicles(*(torch.cat(pair, dim=1) for pair in zip(moved, vehicles)))
    count = vehicles.x.shape[1]
    pairs = compare(both, road, slice(0, count))
    low, high = with_target(body_lanes(both, road), both)
    lanes = (
        LaneRange(low[:, :count, None], high[:, :count, None]),
        LaneRange(low[:, None], high[:, None]),
    )
    room = leave_room(
        moved.part((..., None)),
        both.part((slice(None), None)),
        lanes,
        pairs.distance,
        pairs.order > 0,
        idm,
    )

    # Nobody is in its own way, at neither of its positions.
    itself = torch.eye(count, dtype=torch.bool, device=away.device).repeat(1, 2)
    goes = away & (room | itself).all(-1)
    return vehicles.with_(x=torch.where(goes, moved.x, vehicles.x))
