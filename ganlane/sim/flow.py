"""Vehicles that enter a section of a road and leave it, in a fixed number of slots.

After every decision those who are past the end of the section, or of the exit lane, have left: they
are invalid and wait outside. In every lane a vehicle arrives with a probability of its own, once a
decision at most. It is one of those who wait, at random; with ``exit_share`` one who leaves by the
exit, as long as one waits. It keeps its speed, its memory and its place in its lane, so that only
its position changes. It enters unless anybody would have to brake harder than is safe; then it is
turned away.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ganlane.keys import EGO_INDEX
from ganlane.settings.driving import IdmParameters
from ganlane.settings.road import FlowParameters
from ganlane.sim.lane_ends import at_exit, exiting
from ganlane.sim.random import Purpose, draw_keys, uniform
from ganlane.sim.spawn import leave_room
from ganlane.sim.state import (
    LaneRange,
    Road,
    Vehicles,
    body_lanes,
    lane_change_done,
    reads_are_cheap,
    with_target,
)

#: Bits of the random number that chooses among those who wait.
_CHOICE_BITS = 24


def has_left(vehicles: Vehicles, road: Road, flow: FlowParameters) -> Tensor:
    """Whether each vehicle has passed the end of the section or of the exit lane, bool [N, M].

    The ego never leaves so: that is the end of its episode. Who waits outside has left already.

    Args:
        flow: that of the ``road``.
    """
    left = vehicles.x > flow.to_m
    if road.exit_lane is not None:
        by_exit, _ = at_exit(vehicles, road)
        left = left | by_exit
    return left & ~vehicles.is_ego() & vehicles.valid


def _chosen(vehicles: Vehicles, road: Road, wanted: Tensor, number: Tensor) -> Tensor:
    """Who comes where somebody arrives, at most one of a row, bool [N, M].

    Args:
        vehicles: [N, M], those who wait outside invalid.
        wanted: whether it leaves by the exit, bool [N].
        number: a random one of each slot, [N, M] int64, below ``2 ** _CHOICE_BITS``.
    """
    slot = torch.arange(vehicles.x.shape[1], device=number.device)

    # Who goes another way than wanted; without an exit all go the same.
    exits = exiting(road, number)
    other_way = torch.zeros_like(vehicles.valid) if exits is None else exits != wanted[:, None]

    # Who comes keeps its place in its lane, so it has to have completed its last lane change.
    waits = ~vehicles.valid & (slot != EGO_INDEX) & lane_change_done(vehicles, road)

    # The lowest number of those who go where it is wanted, else of the others: one more bit above
    # the number puts the latter behind, and the next one those who do not wait.
    rank = number + (other_way.long() << _CHOICE_BITS)
    rank = torch.where(waits, rank, 1 << (_CHOICE_BITS + 1))
    is_first = rank == rank.amin(1, keepdim=True)

    # Of equal numbers the lowest slot.
    lowest = torch.where(is_first, slot, len(slot)).amin(1, keepdim=True)
    return waits & (slot == lowest)


def _room(vehicles: Vehicles, comes: Tensor, road: Road, idm: IdmParameters) -> Tensor:
    """Whether nobody, the one who ``comes`` included, brakes harder than is safe, bool [N].

    Args:
        vehicles: [N, M], the one who comes at its new position.
        comes: bool [N, M], true of at most one of a row; where of none, the answer says nothing.
    """
    slot = torch.arange(vehicles.x.shape[1], device=vehicles.x.device)

    # Of who comes, [N, 1]: its slot, its fields, and the lanes that it attends to.
    its = comes.to(torch.uint8).argmax(1, keepdim=True)
    one = Vehicles(*(field.gather(1, its) for field in vehicles))
    lanes = with_target(body_lanes(vehicles, road), vehicles)
    its_lanes = LaneRange(*(lane.gather(1, its) for lane in lanes))

    # Of two at the same position the one with the lower index is ahead.
    distance = vehicles.x - one.x
    ahead = (distance > 0.0) | ((distance == 0.0) & (slot < its))
    return leave_room(one, vehicles, (its_lanes, lanes), distance, ahead, idm).all(1)


def let_in_and_out(
    vehicles: Vehicles,
    road: Road,
    idm: IdmParameters,
    key: Tensor,
    step: Tensor,
    period_s: float,
) -> Vehicles:
    """``vehicles`` [N, M] after some have left and others have entered.

    Args:
        vehicles: all slots, those who wait outside invalid.
        road: with a flow.
        idm: that judges whether there is room.
        key: of the episodes, [N] int64.
        step: physics steps since their start, [N] int64.
        period_s: since the last call, s.
    """
    flow = road.flow
    assert flow is not None

    # First those who leave: their slots are free for those who come.
    stays = ~has_left(vehicles, road, flow)
    vehicles = vehicles.with_(valid=vehicles.valid & stays)

    # [N, L, 2] in float64, as the probabilities are: whether somebody arrives, and by the exit.
    arrivals = flow.arrivals(road.stretches, period_s)
    purposes = [Purpose.FLOW_ARRIVAL, Purpose.FLOW_EXIT]
    u = uniform(key, step, len(arrivals), purposes, torch.float64)

    # [N, M]: the highest bits of a number of each slot.
    keys = draw_keys(key, step, vehicles.x.shape[1], [Purpose.FLOW_SLOT])[..., 0]
    number = (keys >> (64 - _CHOICE_BITS)) & ((1 << _CHOICE_BITS) - 1)

    # Lane by lane, so that nobody enters beside one who has just done so without room.
    for lane, probability in enumerate(arrivals):
        arrives = u[:, lane, 0] < probability
        if probability == 0.0:
            continue
        # Mostly nobody arrives: where a look at the numbers is cheap, the rest is left out.
        if reads_are_cheap(arrives) and not bool(arrives.any()):
            continue

        wanted = u[:, lane, 1] < flow.exit_share
        comes = _chosen(vehicles, road, wanted, number) & arrives[:, None]

        # Moved by whole lanes, who comes is as far from the centre of its lane as before.
        lanes = (lane - vehicles.target_lane).to(vehicles.y.dtype)
        moved = vehicles.with_(
            x=torch.where(comes, flow.from_m, vehicles.x),
            y=torch.where(comes, vehicles.y + lanes * road.lane_width_m, vehicles.y),
            target_lane=torch.where(comes, lane, vehicles.target_lane),
        )

        # Who is turned away waits where it was, and may come again.
        has_room = _room(moved, comes, road, idm)
        enters = comes & has_room[:, None]
        entered = moved.with_(valid=vehicles.valid | enters)
        vehicles = entered.where(enters, vehicles)
    return vehicles
