"""The state of the simulation: vehicles as tensors, their road, and the lanes that they occupy.

When others see a lane change strongly affects the number of crashes, so it is a property of each
vehicle:

- ``CENTRE``: only in the lane of its centre;
- ``BODY``: in every lane that its body enters by more than :data:`ENTRY_M`;
- ``SIGNALLED``: as ``BODY``, and in its target lane from the start of the change on.

The driver of a vehicle always attends to the lanes of its body *and* to its target lane.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ganlane.errors import UserError
from ganlane.keys import EGO_INDEX, VEHICLE_FIELDS
from ganlane.settings.driving import Visibility
from ganlane.settings.road import EXIT, NOTHING, FlowParameters, Stretches, exit_lane

#: A body is in a lane that it reaches into by more than this, m.
ENTRY_M = 0.1
#: In an initial scene: the traffic sets a :class:`Visibility` per episode.
VISIBILITY_OF_EPISODE = -1
#: A lane change is complete, and the next one possible, within this distance of the target lane's
#: centre.
ARRIVED_M = 0.3


def reads_are_cheap(tensor: Tensor) -> bool:
    """Whether reading a value neither breaks a graph that is compiled nor stalls a GPU's queue."""
    return tensor.device.type == "cpu" and not torch.compiler.is_compiling()


class Vehicles(NamedTuple):
    """Fields of ``vehicles`` (:mod:`ganlane.keys`), each [N, M], or [N] for one per row."""

    x: Tensor
    y: Tensor
    heading: Tensor
    speed: Tensor
    acceleration: Tensor
    length: Tensor
    width: Tensor
    desired_speed: Tensor
    target_lane: Tensor
    visibility: Tensor
    valid: Tensor

    @classmethod
    def of(cls, mapping: Any) -> Vehicles:
        """From a mapping of names to tensors, for example a TensorDict."""
        # All items in one pass: every look-up in a TensorDict has its price.
        named = dict(mapping.items())
        return cls(*(named[name] for name in VEHICLE_FIELDS))

    def as_dict(self) -> dict[str, Tensor]:
        """Name to tensor, without copies."""
        return self._asdict()

    def with_(self, **changed: Tensor) -> Vehicles:
        """The same vehicles with some fields replaced."""
        return self._replace(**changed)

    def part(self, index: Any) -> Vehicles:
        """Some of the vehicles: ``field[index]`` of every field."""
        return Vehicles(*(field[index] for field in self))

    def at(self, index: int) -> Vehicles:
        """Vehicle ``index`` of every row, fields [N]."""
        return self.part((slice(None), index))

    def columns(self, which: slice) -> Vehicles:
        """A slice of the vehicles of every row, fields [N, K]."""
        return self if which == slice(None) else self.part((slice(None), which))

    def is_ego(self) -> Tensor:
        """Which vehicles of a row are an ego: the first, bool [M]."""
        return torch.arange(self.x.shape[1], device=self.x.device) == EGO_INDEX

    def with_first(self, first: Vehicles) -> Vehicles:
        """The same rows with vehicle 0 replaced by ``first`` (fields [N])."""
        # By where, not by writing in place: the tensors may belong to the caller.
        return first.part((slice(None), None)).where(self.is_ego()[None], self)

    def with_finite_padding(self) -> Vehicles:
        """The same vehicles with finite numbers in invalid entries: NaN would spread in sums."""

        def finite(field: Tensor) -> Tensor:
            padding = torch.nan_to_num(field, 1.0, 1.0, 1.0)
            return torch.where(self.valid, field, padding)

        return Vehicles(*(finite(field) if field.is_floating_point() else field for field in self))

    def where(self, rows: Tensor, other: Vehicles) -> Vehicles:
        """These vehicles where ``rows`` ([N], [N, 1] or [N, M]) is true, ``other`` elsewhere."""
        mask = rows[:, None] if rows.ndim == 1 else rows
        return Vehicles(*(torch.where(mask, mine, theirs) for mine, theirs in zip(self, other)))


class RowStretches(NamedTuple):
    """Where the lanes of each row begin and end, [N, L]; L is the largest number of lanes.

    Attributes:
        begin_m, end_m: where a lane begins and ends, m;
            :data:`~ganlane.settings.road.FAR_M` behind or ahead where it does not.
        wall_m: where its wall stands, m; :data:`~ganlane.settings.road.FAR_M` without one.
        leave_by_m, changes: those of :class:`~ganlane.settings.road.Leaving`.
    """

    begin_m: Tensor
    end_m: Tensor
    wall_m: Tensor
    leave_by_m: Tensor
    changes: Tensor


@dataclass(frozen=True)
class Road:
    """Lane 0 is the rightmost; the centre of lane k lies at ``y = k * lane_width_m``.

    Attributes:
        lanes, lane_width_m: number of lanes, and their width, m; tensors [N, 1] if every
            environment has its own road (recorded scenes).
        ring_m: closes the road to a ring of that length, m: positions stay unwrapped, only
            distances between vehicles are taken modulo the ring. None: it is straight.
        stretches: where each lane begins and ends (:mod:`ganlane.sim.lane_ends`); empty: all go on
            for ever.
        row_stretches: the same of roads that differ between rows, on which nobody has the mission
            to reach an exit.
        flow: who enters and leaves (:mod:`ganlane.sim.flow`); None: nobody.

    Raises:
        UserError: as many stretches as lanes are needed, one of them without an end and at most one
            with an exit; and the road may be no ring.
    """

    lanes: int | Tensor = 3
    lane_width_m: float | Tensor = 4.0
    ring_m: float | None = None
    stretches: Stretches = ()
    row_stretches: RowStretches | None = None
    flow: FlowParameters | None = None

    def __post_init__(self) -> None:
        if self.flow is not None and not self.stretches:
            raise UserError("a flow of vehicles needs a road whose lanes end; give stretches.")
        if not self.stretches:
            return

        ends = [stretch.end for stretch in self.stretches]
        if (
            len(ends) != self.lanes
            or NOTHING not in ends
            or ends.count(EXIT) > 1
            or self.ring_m is not None
        ):
            raise UserError(
                f"stretches of {len(ends)} lanes with the ends {', '.join(ends)}: expected one for "
                f"each of the {self.lanes} lanes of a straight road, of which one goes on and at "
                "most one ends in an exit."
            )

    @property
    def has_lane_ends(self) -> bool:
        """Whether there is a lane that begins or ends."""
        return bool(self.stretches) or self.row_stretches is not None

    @property
    def exit_lane(self) -> int | None:
        """The lane that ends in an exit, which the ego has to reach; None without one."""
        return exit_lane(self.stretches)

    def clamp_lane(self, lane: Tensor) -> Tensor:
        """``lane``, whole numbers or floats, limited to the road."""
        if isinstance(self.lanes, Tensor):
            leftmost = (self.lanes - 1).to(lane.dtype)
            return torch.minimum(lane.clamp_min(0), leftmost)
        return lane.clamp(0, self.lanes - 1)

    def lane_of(self, y: Tensor) -> Tensor:
        """Lane of the road whose centre is nearest to lateral position ``y``, m; float."""
        return self.clamp_lane(torch.round(y / self.lane_width_m))

    def centre_of(self, lane: Tensor, dtype: torch.dtype | None = None) -> Tensor:
        """Lateral position of the centre of ``lane``, m, in ``dtype``; None: as ``lane``."""
        if dtype is not None:
            lane = lane.to(dtype)
        return lane * self.lane_width_m

    def left_edge_m(self) -> float | Tensor:
        """Lateral position of the left edge of the road, m."""
        return (self.lanes - 0.5) * self.lane_width_m

    def right_edge_m(self) -> float | Tensor:
        """Lateral position of the right edge of the road, m."""
        return -0.5 * self.lane_width_m

    def distance_ahead(self, start: Tensor, end: Tensor) -> Tensor:
        """Signed distance ``end - start`` along the road, m; on a ring the shorter way."""
        distance = end - start
        if self.ring_m is None:
            return distance

        # Into [-half, half): the shorter way round.
        half = 0.5 * self.ring_m
        return torch.remainder(distance + half, self.ring_m) - half


#: Three straight lanes of 4 m.
STRAIGHT = Road()


def road_in(state: Any, default: Road) -> Road:
    """The road of each row from ``state["road"]``, or ``default`` without that key."""
    rows = state.get("road", None)
    if rows is None:
        return default

    stretches = None
    if RowStretches._fields[0] in rows.keys():  # noqa: SIM118 (a TensorDict is no Mapping)
        stretches = RowStretches(*(rows.get(name) for name in RowStretches._fields))

    return Road(rows.get("lanes"), rows.get("lane_width_m"), row_stretches=stretches)


def road_fields(road: Road) -> dict[str, Tensor]:
    """What :func:`road_in` reads of a road that differs between rows: [N, 1], stretches [N, L]."""
    fields = {
        "lanes": road.lanes,
        "lane_width_m": road.lane_width_m,
    }
    if road.row_stretches is not None:
        fields |= road.row_stretches._asdict()
    return fields  # type: ignore[return-value]


# Which lanes a vehicle occupies: as seen by others, and by its own driver


class LaneRange(NamedTuple):
    """Lowest and highest lane of each vehicle, float tensors [N, M]."""

    low: Tensor
    high: Tensor

    def columns(self, which: slice) -> LaneRange:
        """The ranges of a slice of the vehicles."""
        if which == slice(None):
            return self
        return LaneRange(self.low[:, which], self.high[:, which])


def spanned(lanes: LaneRange) -> Tensor:
    """The lanes of a range, [..., 3]: lowest, middle and highest; fewer where those suffice.

    A vehicle at an angle can be in three lanes, if lanes are narrow, vehicles long or changes
    consecutive.
    """
    # Mostly one or two suffice: without this look a decision of idm_random takes 7 % longer with
    # 64 rows and 20 % longer with 1024.
    if reads_are_cheap(lanes.low):
        most = int((lanes.high - lanes.low).amax())
        # One lane: the lowest is the highest. Two: the lowest and the highest.
        if most < 2:
            return torch.stack(lanes[: most + 1], dim=-1)

    middle = torch.minimum(lanes.low + 1, lanes.high)
    return torch.stack((lanes.low, middle, lanes.high), dim=-1)


def lateral_half_extent(vehicles: Vehicles) -> Tensor:
    """Half of the lateral space that each body takes at its heading, m."""
    # A rectangle at an angle takes w cos + l sin across the road.
    return 0.5 * (
        vehicles.width * torch.cos(vehicles.heading)
        + vehicles.length * torch.sin(vehicles.heading).abs()
    )


def body_lanes(vehicles: Vehicles, road: Road) -> LaneRange:
    """Lanes that each body enters by more than :data:`ENTRY_M`."""
    # A corner that just touches the next lane does not count.
    reach = lateral_half_extent(vehicles) - ENTRY_M
    # Right and left edge in one tensor, [2, N, M].
    edges = torch.stack((vehicles.y - reach, vehicles.y + reach))
    return LaneRange(*road.lane_of(edges).unbind())


def with_target(lanes: LaneRange, vehicles: Vehicles) -> LaneRange:
    """``lanes`` extended to the target lane: the lanes that the driver attends to."""
    target = vehicles.target_lane.to(lanes.low.dtype)
    low = torch.minimum(lanes.low, target)
    high = torch.maximum(lanes.high, target)
    return LaneRange(low, high)


def presence(vehicles: Vehicles, road: Road, body: LaneRange, attention: LaneRange) -> LaneRange:
    """Lanes in which others see each vehicle, by its visibility.

    An empty range for invalid vehicles.

    Args:
        body: lanes of the bodies (:func:`body_lanes`).
        attention: those and the target lanes (:func:`with_target`).
    """
    # From the least to the most that others see: centre, body, body and target lane.
    centre = road.lane_of(vehicles.y)
    signalled = vehicles.visibility == int(Visibility.SIGNALLED)
    by_body = vehicles.visibility == int(Visibility.BODY)
    low = torch.where(by_body, body.low, centre)
    low = torch.where(signalled, attention.low, low)
    high = torch.where(by_body, body.high, centre)
    high = torch.where(signalled, attention.high, high)

    # Lowest above highest: in no lane at all.
    low = torch.where(vehicles.valid, low, torch.inf)
    high = torch.where(vehicles.valid, high, -torch.inf)
    return LaneRange(low, high)


def lane_change_done(vehicles: Vehicles, road: Road) -> Tensor:
    """Whether the lane change is done: centre within :data:`ARRIVED_M` of the target lane's centre.

    Bool, of the shape of the vehicles' fields.
    """
    centre = road.centre_of(vehicles.target_lane, vehicles.y.dtype)
    return (vehicles.y - centre).abs() < ARRIVED_M
