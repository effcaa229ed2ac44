"""Leaders and followers, for all vehicles of all environments at once.

The observers are all vehicles (K = M) or a slice of them (the ego alone: K = 1). Several lanes are
evaluated at once: [N, K, L].

The leader is the vehicle ahead whose rear is nearest, of two level ones the slower; the follower is
the vehicle behind whose front is nearest, of two level ones that with the lower index. Two ways
lead to them, bit for bit the same. *Pairs* [N, K, L, M] compare each observer with every vehicle:
for graphs, for gradients, and for few vehicles. *Sorting* puts each row in the order of the road
once; a running minimum from the front then gives everybody's leader in every lane, one from the
rear the followers.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from ganlane.sim.state import (
    LaneRange,
    Road,
    Vehicles,
    body_lanes,
    presence,
    reads_are_cheap,
    with_target,
)

#: Gap in an empty lane, m (Table V's 'maximum gap for empty lane').
FREE_GAP_M = 10_000.0
#: Rows times pairs of vehicles from which on sorting is faster; the pairs stay for fewer, and where
#: sorting is impossible (:func:`perceive`). Microseconds of :func:`perceive`
#: and :func:`~ganlane.sim.idm.following_acceleration` on 3 lanes, one core, sorting and pairs, rows
#: x vehicles: 1 x 9 265, 186; 64 x 9 310, 298; 128 x 9 413, 579; 16 x 30 427, 501; 64 x 100 926,
#: 16917.
SORTS_FROM = 8000
#: Added to masked values, so that a minimum ignores them; also where nobody is, m.
_BEYOND = 1e9
#: Breaks ties of position without changing any other distance, m.
_TIE_M = 1e-30
_INT32_MIN = torch.iinfo(torch.int32).min
#: The sorting key of nobody: an end at infinity (0x7F800000), in the upper 32 bits.
_NOBODY = 0x7F800000 << 32


class Neighbour(NamedTuple):
    """The nearest vehicle of a kind, per observer and lane.

    Attributes:
        gap: bumper to bumper, m; :data:`FREE_GAP_M` without a neighbour, negative for an overlap
            along the road.
        speed: m/s; the observer's own without a neighbour.
    """

    gap: Tensor
    speed: Tensor


class Follower(NamedTuple):
    """The nearest vehicle behind, per observer and lane.

    Attributes:
        gap: bumper to bumper, m; :data:`FREE_GAP_M` without one.
        speed, desired_speed: m/s; anyone's without one.
        exists: whether there is one, bool.
    """

    gap: Tensor
    speed: Tensor
    desired_speed: Tensor
    exists: Tensor


class Pairs(NamedTuple):
    """Every vehicle relative to every observer, [N, K, M].

    Attributes:
        distance: between the centres, m, positive for a vehicle ahead.
        gap: between the bumpers, m, whoever is ahead.
        order: the distance with ties broken: of two vehicles at the same x the one with the lower
            index is ahead.
    """

    distance: Tensor
    gap: Tensor
    order: Tensor

    @property
    def ahead(self) -> Tensor:
        """Gap to every vehicle ahead, m; :data:`FREE_GAP_M` for the others."""
        return _beyond(self.gap, self.order <= 0).clamp_max(FREE_GAP_M)

    @property
    def behind(self) -> Tensor:
        """Gap to every vehicle behind, m; :data:`FREE_GAP_M` for the others."""
        return _beyond(self.gap, self.order >= 0).clamp_max(FREE_GAP_M)


class Scene(NamedTuple):
    """M vehicles as K observers see them, computed once per step.

    Attributes:
        which: of the vehicles are the observers.
        observers: [N, K].
        vehicles: [N, M].
        road: that they are on.
        body: lanes that the body of each observer is in, [N, K].
        attention: lanes that its driver attends to, [N, K].
        presence: lanes in which others see each vehicle, [N, M].
        queue: int64 [N, M], the vehicles in the order of the road, the foremost first, and
            everybody's place in that order. With it neighbours are found by sorting.
        compared: without a queue they are found by these pairs.
    """

    which: slice
    observers: Vehicles
    vehicles: Vehicles
    road: Road
    body: LaneRange
    attention: LaneRange
    presence: LaneRange
    queue: tuple[Tensor, Tensor] | None
    compared: Pairs | None

    @property
    def pairs(self) -> Pairs:
        """The :class:`Pairs` of observers and vehicles."""
        return self.compared or compare(self.vehicles, self.road, self.which)


def _beyond(number: Tensor, where: Tensor) -> Tensor:
    """Adds 1e9 where masked, so that ``min`` ignores it (branch-free ``where``).

    On a CPU ``torch.where`` branches at every element and takes five times as long. Adding 0 leaves
    a number unchanged to the last bit; NaN would stay NaN, so padding has to be finite.
    """
    return torch.add(number, where, alpha=_BEYOND)


def compare(vehicles: Vehicles, road: Road, which: slice = slice(None)) -> Pairs:
    """The :class:`Pairs` of all vehicles as observers, or of a slice of them."""
    # [N, K, 1] against [N, 1, M].
    distance = road.distance_ahead(vehicles.x[:, which, None], vehicles.x[:, None, :])
    # Between the bumpers: the distance of the centres less half of both lengths.
    half = 0.5 * vehicles.length
    gap = distance.abs() - (half[:, which, None] + half[:, None, :])

    index = torch.arange(vehicles.x.shape[1], device=vehicles.x.device)
    # In the run's float type: whole numbers times a float would be in torch's default one.
    order = torch.sign(index[which, None] - index).to(distance.dtype)
    return Pairs(distance, gap, distance + order * _TIE_M)


def perceive(vehicles: Vehicles, road: Road, which: slice = slice(None)) -> Scene:
    """The :class:`Scene` of ``vehicles`` as seen by all of them or by a slice of them."""
    body = body_lanes(vehicles, road)
    attention = with_target(body, vehicles)
    x = vehicles.x

    # It pays where all vehicles observe and pairs are many, and is possible where the rest holds.
    sorts = (
        which == slice(None)
        and x.shape[0] * x.shape[1] ** 2 >= SORTS_FROM
        and reads_are_cheap(x)
        # a key holds two numbers of 32 bits
        and x.dtype == torch.float32
        # a ring has no first vehicle
        and road.ring_m is None
        # keys have no gradient
        and not (x.requires_grad or vehicles.speed.requires_grad)
    )

    return Scene(
        which=which,
        observers=vehicles.columns(which),
        vehicles=vehicles,
        road=road,
        body=body.columns(which),
        attention=attention.columns(which),
        presence=presence(vehicles, road, body, attention),
        queue=_queue(x) if sorts else None,
        compared=None if sorts else compare(vehicles, road, which),
    )


def in_lane(scene: Scene, lane: Tensor) -> Tensor:
    """Whether vehicle j is in ``lane`` of observer i.

    Bool [N, K, M], or [N, K, L, M] for L lanes [N, K, L].
    """
    # [N, 1, ..., M], against lanes of one or two more axes.
    low, high = scene.presence
    for _ in range(lane.ndim - 1):
        low = low.unsqueeze(1)
        high = high.unsqueeze(1)
    asked = lane[..., None]
    return (low <= asked) & (asked <= high)


def leader(scene: Scene, lane: Tensor) -> Neighbour:
    """The nearest vehicle ahead of each observer in its ``lane``.

    Float [N, K], or [N, K, L] for L of them; the result has that shape.
    """
    lanes = lane[..., None] if lane.ndim == 2 else lane
    speed = scene.vehicles.speed
    if scene.queue is None:
        ends = _candidates(scene, lanes, 1)
        rear = ends.amin(-1)
        # Of level vehicles the lowest speed, so that their order does not matter.
        farther = ends > rear[..., None]
        its_speed = _beyond(speed[:, None, None, :], farther).amin(-1)
    else:
        # The lower half of a key is not below 0.
        second = _ordered(speed) - _INT32_MIN
        key = _nearest_key(scene, scene.queue, lanes, 1, second)
        rear = _unordered(key >> 32)
        its_speed = _unordered((key & 0xFFFFFFFF) + _INT32_MIN)

    gap = _gap(scene, rear, 1)
    its_speed = torch.where(gap < FREE_GAP_M, its_speed, scene.observers.speed[..., None])
    return Neighbour(gap.view_as(lane), its_speed.view_as(lane))


def follower(scene: Scene, lane: Tensor) -> Follower:
    """The nearest vehicle behind each observer in its ``lane``.

    Float [N, K], or [N, K, L] for L of them; the result has that shape.
    """
    lanes = lane[..., None] if lane.ndim == 2 else lane
    vehicles = scene.vehicles
    gap, index = nearest(scene, lanes, -1)
    gap = gap.view_as(lane)

    # What else is known of the vehicle that was found.
    flat = index.flatten(1)
    speed = vehicles.speed.gather(1, flat).view_as(lane)
    desired_speed = vehicles.desired_speed.gather(1, flat).view_as(lane)
    return Follower(gap, speed, desired_speed, gap < FREE_GAP_M)


def nearest(scene: Scene, lanes: Tensor, side: int) -> tuple[Tensor, Tensor]:
    """Gap, m, and index of the nearest vehicle ahead (``side`` 1) or behind (-1) in ``lanes``.

    All [N, K, L]. Of two level ones that with the lower index; without one the gap is
    :data:`FREE_GAP_M`, and the index anyone's.
    """
    if scene.queue is None:
        end, index = _candidates(scene, lanes, side).min(-1)
    else:
        numbers = torch.arange(scene.vehicles.x.shape[1], device=lanes.device)
        key = _nearest_key(scene, scene.queue, lanes, side, numbers)
        end = _unordered(key >> 32)
        # Nobody's key has the index 0.
        index = key & 0xFFFFFFFF

    return _gap(scene, end, side), index


def _candidates(scene: Scene, lanes: Tensor, side: int) -> Tensor:
    """Where the near end of each vehicle ahead (``side`` 1) or behind (-1) in each lane is, m,
    [N, K, L, M].

    Along ``side``: of vehicles ahead the rear, of vehicles behind the front with its sign changed.
    On a ring from the observer on; else on the road, so that it is one number per vehicle, whoever
    looks.
    """
    # On a ring nobody is first, so ends are seen from each observer.
    v = scene.vehicles
    pairs = scene.pairs
    x = v.x[:, None, :] if scene.road.ring_m is None else pairs.distance
    end = side * x - (0.5 * v.length)[:, None, :]

    elsewhere = pairs.order <= 0 if side > 0 else pairs.order >= 0
    # In two steps: leader and follower in several lanes then share the first, [N, K, M], which a
    # compiler keeps. In one step compiled idm_mobil took twice as long.
    ends = _beyond(end, elsewhere)[:, :, None, :]
    return _beyond(ends, ~in_lane(scene, lanes))


def _gap(scene: Scene, end: Tensor, side: int) -> Tensor:
    """Gap from each observer's bumper to ``end``, m; :data:`FREE_GAP_M` where nobody is."""
    o = scene.observers
    distance = end
    if scene.road.ring_m is None:
        distance = torch.sub(end, o.x[..., None], alpha=side)
    return torch.sub(distance, o.length[..., None], alpha=0.5).clamp_max(FREE_GAP_M)


# Sorting


def _queue(x: Tensor) -> tuple[Tensor, Tensor]:
    """The order of vehicles at ``x`` [N, M] and their places in it, int64 [N, M] each.

    Of two at the same x the one with the lower index is ahead.
    """
    turn = x.sort(dim=1, descending=True, stable=True).indices
    numbers = torch.arange(x.shape[1], device=x.device).expand_as(turn)
    place = torch.empty_like(turn).scatter_(1, turn, numbers)
    return turn, place


def _nearest_key(
    scene: Scene,
    queue: tuple[Tensor, Tensor],
    lane: Tensor,
    side: int,
    second: Tensor,
) -> Tensor:
    """The key of the vehicle with the nearest end in each lane [N, K, L], ahead (``side`` 1) or
    behind (-1).

    A key is 64 bits long: first the end as in :func:`_candidates`, then ``second``, which decides
    between level ends. So a minimum of keys finds the neighbour and holds what is to be known of
    it.

    Args:
        queue: as of :class:`Scene`.
        second: of each vehicle, [N, M] int64, 0 to 2^32 - 1.
    """
    v = scene.vehicles
    turn, place = queue
    count = lane.shape[1]
    lanes = scene.road.lanes
    if isinstance(lanes, Tensor):
        lanes = int(lanes.max())
    if side < 0:
        # From the rear.
        turn = turn.flip(1)
        place = count - 1 - place

    # Everybody's near end, in the order of the road.
    end = _ordered(side * v.x - 0.5 * v.length)
    key = ((end << 32) | second).gather(1, turn)
    low = scene.presence.low.gather(1, turn)
    high = scene.presence.high.gather(1, turn)

    number = torch.arange(lanes, device=v.x.device)[:, None, None]
    # [lanes, N, M]: everybody's key in the lanes that it is seen in.
    key = torch.where((low <= number) & (number <= high), key, _NOBODY)

    # Entry k of a lane: the nearest among the first k in the queue; among none it is nobody.
    before = pad(key[..., :-1], (1, 0), value=_NOBODY)
    nearest = before.cummin(-1).values.transpose(0, 1).flatten(1)

    # Place of the observer's entry: lane by lane, as many entries as vehicles.
    entry = lane.clamp(0, lanes - 1).long() * count + place[..., None]
    neighbour = nearest.gather(1, entry.flatten(1)).view_as(lane)
    return torch.where((lane >= 0) & (lane < lanes), neighbour, _NOBODY)


def _ordered(number: Tensor) -> Tensor:
    """A whole number of 32 bits (as int64) that orders as ``number`` (float32) does.

    The bits of floats above 0 order as whole numbers do; those below 0 the other way round, so all
    their bits but the sign are turned over. :func:`_unordered` undoes it.
    """
    # -0 becomes 0.
    bits = (number + 0.0).view(torch.int32)
    return (bits ^ ((bits >> 31) & 0x7FFFFFFF)).long()


def _unordered(whole: Tensor) -> Tensor:
    """The float32 of a whole number of :func:`_ordered`."""
    bits = whole.int()
    return (bits ^ ((bits >> 31) & 0x7FFFFFFF)).view(torch.float32)
