"""Lanes that begin and end: where one may change, who stops before an end, and who has to leave.

The end of a lane that a driver has to leave makes its lane changes mandatory. In MOBIL that is a
bias of the incentive (Kesting, Treiber and Helbing 2007; Treiber and Kesting 2013);
here it grows as the end nears, as the mandatory desire of Schakel, Knoop and van Arem (2012) does:

    urgency = 1 - distance / (changes * 500 m), from 0 to 1.

A change into a lane that is less urgent to leave has the bias of the lane that it leaves; nobody
changes into one that is more urgent to leave. MOBIL's safety criterion holds for these changes as
for all others.

All functions take lanes of any shape that broadcasts with the positions, whole numbers or floats.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ganlane.settings.road import (
    ASKS_FROM,
    EXIT,
    FAR_M,
    NOTHING,
    TURN_OUT_M,
    WALL,
    FlowParameters,
    LaneStretch,
    Stretches,
    leaving,
)
from ganlane.sim.state import LaneRange, Road, RowStretches, Vehicles, spanned
from ganlane.torch_settings import constant

#: A number of each lane: of one road, or [N, L] of every row's.
OfLanes = tuple[float, ...] | Tensor


def of_lane(numbers: OfLanes, lane: Tensor, like: Tensor) -> Tensor:
    """The number of each ``lane``, in the type of ``like``; beyond the road, of the nearest one.

    Args:
        numbers: one of each lane; where every row has its own, the first dimension of ``lane`` is
            that of the rows.
    """
    if isinstance(numbers, Tensor):
        index = lane.long().clamp(0, numbers.shape[1] - 1)
        return numbers.gather(1, index.flatten(1)).view(index.shape)

    return constant(numbers, like)[lane.long().clamp(0, len(numbers) - 1)]


def begins(road: Road) -> OfLanes:
    """Where each lane begins, m."""
    if road.row_stretches is not None:
        return road.row_stretches.begin_m
    return tuple(stretch.begin_m for stretch in road.stretches)


def ends(road: Road) -> OfLanes:
    """Where each lane ends, m; :data:`FAR_M` if it goes on."""
    if road.row_stretches is not None:
        return road.row_stretches.end_m
    return tuple(stretch.end_m for stretch in road.stretches)


def walls(road: Road) -> OfLanes:
    """Where each lane's wall stands, m; :data:`FAR_M` without one."""
    if road.row_stretches is not None:
        return road.row_stretches.wall_m
    return tuple(its.end_m if its.end == WALL else FAR_M for its in road.stretches)


def on_road(road: Road, lane: Tensor) -> Tensor:
    """Whether the road has the ``lane`` anywhere, bool."""
    lanes = road.lanes
    if isinstance(lanes, Tensor):
        # [N, 1] as the rows of ``lane``, which may have more dimensions.
        lanes = lanes.view(-1, *[1] * (lane.ndim - 1))
    return (lane >= 0) & (lane < lanes)


def exists(road: Road, lane: Tensor, x: Tensor) -> Tensor:
    """Whether the road has the ``lane`` at ``x``, m; bool."""
    inside = on_road(road, lane)
    if not road.has_lane_ends:
        return inside

    begin = of_lane(begins(road), lane, x)
    end = of_lane(ends(road), lane, x)
    return inside & (begin <= x) & (x < end)


def may_change(road: Road, lane: Tensor, side: Tensor, x: Tensor) -> Tensor:
    """Whether one may go from ``lane`` to the one at its ``side`` (1 left, -1 right, 0 none).

    Both have to exist at ``x``, m; keeping the lane is always possible. Bool.
    """
    there = exists(road, lane + side, x)
    if not road.has_lane_ends:
        return there
    # Nobody changes out of a lane that does not exist where it is.
    return (side == 0) | (there & exists(road, lane, x))


def leaves_road(road: Road, y: Tensor, new_y: Tensor, x: Tensor) -> Tensor:
    """Whether a body at ``x`` that moves from ``y`` to ``new_y`` has crossed a line beside which
    there is no lane to change into; m, [N, 1], bool.
    """
    # Not by Road.lane_of, which clamps to the road: beside the outermost lane there is none.
    lane = torch.round(y / road.lane_width_m)
    side = torch.round(new_y / road.lane_width_m) - lane
    return (side != 0) & ~may_change(road, lane, side, x)


def room_before_wall(vehicles: Vehicles, lanes: Tensor, road: Road) -> Tensor:
    """From the front bumper of each vehicle [N, K] to the wall of ``lanes`` [N, K, L], m.

    Below 0 behind it.
    """
    front = vehicles.x + 0.5 * vehicles.length
    return of_lane(walls(road), lanes, vehicles.x) - front[..., None]


def hits_wall(vehicles: Vehicles, body: LaneRange, road: Road) -> Tensor:
    """Whether each vehicle [N, K], in the lanes ``body``, has driven into a wall; bool."""
    room = room_before_wall(vehicles, spanned(body), road)
    return (room < 0.0).any(-1)


def at_exit(vehicles: Vehicles, road: Road) -> tuple[Tensor, Tensor]:
    """Whether each vehicle has left the road by its exit, and whether it has missed it, bool.

    The ``road`` has to have an exit.
    """
    assert road.exit_lane is not None
    passed = vehicles.x >= ends(road)[road.exit_lane]
    inside = road.lane_of(vehicles.y) == road.exit_lane
    return passed & inside, passed & ~inside


def exiting(road: Road, like: Tensor) -> Tensor | None:
    """Which of the drivers ``like`` [N, M] leave the road by its exit, bool [M]; None without one.

    The first of them is the ego, whose mission is the exit.
    """
    if road.exit_lane is None:
        return None
    flow = road.flow or FlowParameters()
    return constant(flow.exits(like.shape[-1]), like) > 0


def bias(
    road: Road,
    lanes: Tensor,
    x: Tensor,
    strongest: float,
    reach_m: float,
) -> Tensor:
    """How much a driver at ``x`` [N, K], m, wants to leave each of ``lanes`` [N, K, L], m/s2.

    The first driver is the ego; some want to reach the exit lane (:func:`exiting`). 0 where nothing
    is urgent.

    Args:
        strongest: at the end, m/s2.
        reach_m: distance from the end at which it begins, m per lane change.
    """
    # Lanes to leave because they end, and for some because they do not lead to the exit.
    urgency = _urgency(road, lanes, x, None, reach_m)
    exits = exiting(road, lanes[..., 0])
    if exits is not None:
        to_exit = _urgency(road, lanes, x, road.exit_lane, reach_m)
        urgency = torch.where(exits[..., None], to_exit, urgency)
    return strongest * urgency.clamp(0.0, 1.0)


def _urgency(road: Road, lanes: Tensor, x: Tensor, goal: int | None, reach_m: float) -> Tensor:
    """How urgent it is to leave ``lanes`` [N, K, L]; not bounded to 0 and 1.

    ``goal`` is the lane to reach; None: any that goes on.
    """
    # By where each lane has to be left, and from how far before that on drivers want to.
    by_m: OfLanes
    reaches: OfLanes
    if road.row_stretches is not None:
        by_m = road.row_stretches.leave_by_m
        reaches = reach_m * road.row_stretches.changes
    else:
        by_m, changes = leaving(road.stretches, goal)
        reaches = tuple(reach_m * number for number in changes)

    distance = of_lane(by_m, lanes, x) - x[..., None]
    return 1.0 - distance / of_lane(reaches, lanes, x)


def stretches_of_roads(roads: Sequence[Stretches]) -> RowStretches:
    """The stretches of S roads, in every row one, float64 [S, L].

    Lanes that a road does not have, but another one has, go on.
    """
    widest = max(len(stretches) for stretches in roads)
    # The numbers of a lane that a road does not have, in the order of RowStretches.
    beyond = (-FAR_M, FAR_M, FAR_M, FAR_M, 1.0)

    # [S, 5, L]
    rows = []
    for stretches in roads:
        road = Road(len(stretches), stretches=stretches)
        numbers = (begins(road), ends(road), walls(road), *leaving(stretches))
        missing = widest - len(stretches)
        row = []
        for of_lanes, far in zip(numbers, beyond):
            row.append([*of_lanes, *[far] * missing])
        rows.append(row)

    fields = torch.tensor(rows, dtype=torch.float64).unbind(1)
    return RowStretches(*fields)


def from_start(stretches: RowStretches, start_m: Tensor, dtype: torch.dtype) -> RowStretches:
    """The stretches of each row, positions measured from ``start_m`` [N, 1] on, in ``dtype``."""

    def moved(place_m: Tensor) -> Tensor:
        """Positions [N, L], m, measured from the start."""
        # FAR_M says that there is nothing, and stays that number.
        return torch.where(place_m.abs() < FAR_M, place_m - start_m, place_m).to(dtype)

    return RowStretches(
        begin_m=moved(stretches.begin_m),
        end_m=moved(stretches.end_m),
        wall_m=moved(stretches.wall_m),
        leave_by_m=moved(stretches.leave_by_m),
        changes=stretches.changes.to(dtype),
    )


def stretches_of_row(stretches: RowStretches, row: int) -> Stretches:
    """The lanes of one row, as :func:`stretches_of_roads` was given them."""
    begins_m = stretches.begin_m[row].tolist()
    ends_m = stretches.end_m[row].tolist()
    walls_m = stretches.wall_m[row].tolist()

    lanes = []
    for begin_m, end_m, wall_m in zip(begins_m, ends_m, walls_m):
        if wall_m < FAR_M:
            end = WALL
        elif end_m < FAR_M:
            end = EXIT
        else:
            end = NOTHING
        lanes.append(LaneStretch(begin_m, end_m, end))
    return tuple(lanes)


class WaysOut(NamedTuple):
    """Where each driver may and has to go, [N, M].

    Attributes:
        left, right: whether it may go to that side, bool.
        side: to which it has to leave its lane: -1 right, 0 none, 1 left.
        urgency: of leaving it, 0 to 1; 0 where ``side`` is.
    """

    left: Tensor
    right: Tensor
    side: Tensor
    urgency: Tensor

    @property
    def asks(self) -> Tensor:
        """Whether each has to leave its lane so soon that others make room, bool."""
        return (self.side != 0) & (self.urgency > ASKS_FROM)


def ways_out(vehicles: Vehicles, road: Road, reach_m: float) -> WaysOut:
    """Where the drivers may and have to go.

    Args:
        vehicles: [N, M], the ego first.
        road: that they are on.
        reach_m: as of :func:`bias`.
    """
    # Own lane first, then left and right, [N, M, 3].
    lane = vehicles.target_lane
    sides = constant((0, 1, -1), lane)
    lanes = lane[..., None] + sides
    urgency = bias(road, lanes, vehicles.x, 1.0, reach_m)
    here = urgency[..., :1]

    # Nobody goes where it is more urgent to leave.
    possible = may_change(road, lane[..., None], sides, vehicles.x[..., None])[..., 1:]
    possible = possible & (here >= urgency[..., 1:])
    left, right = possible.unbind(-1)

    # The better one of two sides, the left one at a tie; a lane as urgent is none.
    out = torch.where(possible & (here > urgency[..., 1:]), urgency[..., 1:], torch.inf)
    to_the_left, to_the_right = out.unbind(-1)
    side = torch.where(to_the_left <= to_the_right, 1, -1)
    side = torch.where(torch.isfinite(out).any(-1), side, 0)

    urgency = torch.where(side != 0, here[..., 0], 0.0)
    return WaysOut(left, right, side, urgency)


def stopping_room(
    vehicles: Vehicles,
    lanes: Tensor,
    road: Road,
    keeps: Tensor,
) -> tuple[Tensor, Tensor]:
    """Room in which each driver [N, K] has to stop in ``lanes`` [N, K, L], m; whether it has to.

    Args:
        keeps: whether it keeps the lane, bool [N, K, L]: it stops so far before the wall that it
            can still turn out; who leaves the lane goes on up to the wall itself.
    """
    room = room_before_wall(vehicles, lanes, road)
    has_wall = of_lane(walls(road), lanes, vehicles.x) < FAR_M
    return torch.where(keeps, room - TURN_OUT_M, room), has_wall
