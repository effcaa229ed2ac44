"""MOBIL lane-changing model (Kesting et al. 2007) with the paper's Table IV.

Where lanes end, changes out of them are mandatory (:mod:`ganlane.sim.lane_ends`).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ganlane.keys import EGO_INDEX
from ganlane.settings.driving import MobilParameters
from ganlane.sim.idm import (
    TABLE_V,
    AnyIdm,
    DriverIdm,
    acceleration_before_wall,
    acceleration_behind,
    idm_acceleration,
)
from ganlane.sim.lane_ends import WaysOut, bias, may_change, ways_out
from ganlane.sim.neighbours import FREE_GAP_M, Scene, compare, follower, leader, nearest
from ganlane.sim.state import Road, Vehicles, lane_change_done, reads_are_cheap
from ganlane.torch_settings import constant

TABLE_IV = MobilParameters()


class LaneAccelerations(NamedTuple):
    """Accelerations in the observer's lane and those beside it, m/s2, [N, K, L].

    Attributes:
        observer: the observer's own.
        with_it: of its follower in that lane, with the observer in front of it; 0 where there is
            no follower.
        without: the same without the observer.
    """

    observer: Tensor
    with_it: Tensor
    without: Tensor

    def of(self, lanes: slice) -> LaneAccelerations:
        """Some of the lanes."""
        return LaneAccelerations(*(number[..., lanes] for number in self))


def lane_accelerations(scene: Scene, lanes: Tensor, idm: AnyIdm) -> LaneAccelerations:
    """The :class:`LaneAccelerations` of each observer in ``lanes`` [N, K, L] (float).

    With per-driver parameters, each driver predicts the others with its own parameters: it does not
    know theirs.
    """
    ahead = leader(scene, lanes)
    behind = follower(scene, lanes)
    speed = scene.observers.speed[..., None]
    length = scene.observers.length[..., None]

    # The follower with the observer in front of it ...
    driver = (behind.speed, behind.desired_speed)
    with_it = idm_acceleration(*driver, behind.gap, speed, idm.per_lane())

    # ... and without it: behind the observer's leader, or alone.
    free = ahead.gap >= FREE_GAP_M
    leader_speed = torch.where(free, behind.speed, ahead.speed)
    between = behind.gap + length + ahead.gap
    gap = torch.where(free, FREE_GAP_M, between)
    without = idm_acceleration(*driver, gap, leader_speed, idm.per_lane())

    # Nobody behind: nobody is hindered or relieved.
    nobody = ~behind.exists
    with_it = with_it.masked_fill(nobody, 0.0)
    without = without.masked_fill(nobody, 0.0)

    observer = acceleration_behind(scene, ahead, idm)
    if scene.road.has_lane_ends:
        # Whoever changes into a lane means to keep it.
        keeps = torch.ones_like(lanes, dtype=torch.bool)
        before_wall = acceleration_before_wall(scene, lanes, keeps, idm)
        observer = torch.minimum(observer, before_wall)
    return LaneAccelerations(observer, with_it, without)


def mobil_criterion(
    there: LaneAccelerations,
    here: LaneAccelerations,
    mobil: MobilParameters,
    politeness: Tensor | float = 1.0,
) -> tuple[Tensor, Tensor]:
    """MOBIL's two criteria of a change from ``here`` [N, K, 1] to ``there`` [N, K, L].

    Args:
        there: in the lanes to change into.
        here: in the observer's own lane.
        mobil: weights of the followers, and what is safe.
        politeness: a factor on both weights, [N, K, 1] or one for all.

    Returns:
        The incentive, m/s2, what the driver gains plus what its followers gain, weighted, and
        whether the change is safe (Kesting et al. 2007): neither the new follower nor the driver
        brakes harder than ``safe_deceleration``. Both [N, K, L].
    """
    # What the new follower gains (mostly below 0), and what the old one gains.
    burden = there.with_it - there.without
    relief = here.without - here.with_it

    incentive = (
        there.observer
        - here.observer
        + politeness * mobil.politeness_side * burden
        + politeness * mobil.politeness_rear * relief
    )

    hardest = torch.minimum(there.with_it, there.observer)
    safe = hardest >= -mobil.safe_deceleration
    return incentive, safe


def safe_change(
    scene: Scene,
    lane: Tensor,
    idm: AnyIdm = TABLE_V,
    mobil: MobilParameters = TABLE_IV,
) -> Tensor:
    """MOBIL's safety criterion for a change into ``lane`` [N, K] (float), bool [N, K]."""
    # Safety does not depend on where the vehicle is now: that lane stands in for it.
    there = lane_accelerations(scene, lane[..., None], idm)
    _, safe = mobil_criterion(there, there, mobil)
    return safe[..., 0]


def without_ego(wish: Tensor) -> Tensor:
    """``wish`` [N, M] with the ego's column zeroed: others do not know its intention."""
    others = wish[:, EGO_INDEX + 1 :]
    ego = torch.zeros_like(wish[:, : EGO_INDEX + 1])
    return torch.cat((ego, others), dim=1)


def one_at_a_time(
    scene: Scene,
    wish: Tensor,
    idm: AnyIdm = TABLE_V,
    mobil: MobilParameters = TABLE_IV,
) -> Tensor:
    """``wish`` (-1, 0, +1 lanes, [N, M]), 0 where a vehicle ahead that wants the same lane is too
    close.

    Too close means nearer than ``exclusive_m`` (centre to centre), or requiring unsafe braking.
    MOBIL's criteria do not cover this case, since neither vehicle is in that lane yet.

    Args:
        scene: with all vehicles as observers.
    """
    vehicles = scene.vehicles
    if not reads_are_cheap(wish):
        gives_way = _gives_way(vehicles, scene.road, wish, idm, mobil)
        return torch.where(gives_way, 0, wish)

    # Rivals are rare: among all pairs a decision of idm_random takes 5 % longer with 1024 rows.
    wants = wish != 0
    rivals = wants & (wants.sum(1, keepdim=True) > 1)
    rows = rivals.any(1).nonzero()[:, 0]
    if len(rows) == 0:
        return wish

    # Only their rows [R], and as many columns W as hold all of them.
    rivals = rivals[rows]
    most = int(rivals.sum(1).max())
    rivals_first = rivals.to(torch.uint8).sort(dim=1, descending=True, stable=True)
    columns = rivals_first.indices[:, :most]

    # The same question, asked of [R, W] vehicles.
    few = Vehicles(*(field[rows].gather(1, columns) for field in vehicles))
    their_idm = idm.of(rows, columns) if isinstance(idm, DriverIdm) else idm
    wishes = wish[rows]
    asked = wishes.gather(1, columns)
    gives_way = _gives_way(few, scene.road, asked, their_idm, mobil)
    granted = torch.where(gives_way, 0, asked)

    # Back into their columns, and these rows among all.
    wishes = wishes.scatter(1, columns, granted)
    return wish.index_copy(0, rows, wishes)


def _gives_way(
    vehicles: Vehicles,
    road: Road,
    wish: Tensor,
    idm: AnyIdm,
    mobil: MobilParameters,
) -> Tensor:
    """Whether a vehicle ahead that wants the same lane is too close, bool [N, M]."""
    # Two that want the same lane from its two sides do not see each other in it yet.
    pairs = compare(vehicles, road)

    # [N, i, j]: i and j want the same lane.
    wants = wish != 0
    target = vehicles.target_lane + wish
    both = wants[:, None, :] & wants[:, :, None]
    same = both & (target[:, None, :] == target[:, :, None])

    # What i would do behind j, and whether j is too close ahead.
    speed = vehicles.speed[:, :, None]
    desired = vehicles.desired_speed[:, :, None]
    leader_speed = vehicles.speed[:, None, :]
    demand = idm_acceleration(speed, desired, pairs.ahead, leader_speed, idm.per_lane())
    near = (pairs.distance < mobil.exclusive_m) | (demand < -mobil.safe_deceleration)
    return (same & near & (pairs.order > 0)).any(-1)


def falling_behind(scene: Scene, ways: WaysOut, idm: AnyIdm, mobil: MobilParameters) -> Tensor:
    """Acceleration of each observer who has to change its lane soon and is kept from it by who is
    ahead there, m/s2, [N, K]; infinite for others.

    It brakes with ``courtesy`` where the leader in the lane that it has to reach makes the change
    unsafe, so that it does not stay beside it. Where it does not, the driver keeps its speed, and
    passes those who drive beside it.

    Args:
        ways: of the observers.
        idm: that judges whether the change is safe.
        mobil: what is safe, and how hard it brakes.
    """
    ahead = leader(scene, _wanted_lane(scene, ways))
    demand = acceleration_behind(scene, ahead, idm)
    blocked = demand < -mobil.safe_deceleration
    return _courteous(scene, ways, blocked, mobil)


def letting_past(scene: Scene, ways: WaysOut, idm: AnyIdm, mobil: MobilParameters) -> Tensor:
    """Acceleration of each observer who has to change its lane soon, and for whom nobody there
    makes room, m/s2, [N, K]; infinite for others.

    It brakes with ``courtesy`` where the follower in the lane that it has to reach makes the change
    unsafe, until that one is faster by as much as a second of this braking makes, and goes past.
    One who stands, or brakes with more than half of ``courtesy``, makes room or waits itself: for
    that one the driver does not wait. Drivers who have to change adapt their speed to the gap
    beside them so in Hidas (2005) and Schakel, Knoop and van Arem (2012).

    Args:
        ways: of the observers.
        idm: that judges whether the change is safe.
        mobil: what is safe, and how hard it brakes.
    """
    # The follower in that lane, [N, K, 1].
    gap, index = nearest(scene, _wanted_lane(scene, ways), -1)
    behind = Vehicles(*(field.gather(1, index[..., 0])[..., None] for field in scene.vehicles))

    # How it would have to brake after the change.
    speed = scene.observers.speed[..., None]
    demand = idm_acceleration(behind.speed, behind.desired_speed, gap, speed, idm.per_lane())
    unsafe = (gap < FREE_GAP_M) & (demand < -mobil.safe_deceleration)

    # Whether it goes past, or would wait for the driver in its turn.
    goes_on = (behind.speed > 0.0) & (behind.acceleration > -0.5 * mobil.courtesy)
    # Braking for a second changes the speed by as much as ``courtesy`` says.
    goes_on = goes_on & (behind.speed - speed < mobil.courtesy)
    return _courteous(scene, ways, unsafe & goes_on, mobil)


def _wanted_lane(scene: Scene, ways: WaysOut) -> Tensor:
    """The lane that each observer has to reach, float [N, K, 1]."""
    lane = scene.observers.target_lane + ways.side
    return lane.to(scene.observers.x.dtype)[..., None]


def _courteous(scene: Scene, ways: WaysOut, hindered: Tensor, mobil: MobilParameters) -> Tensor:
    """The braking [N, K] of who has to change its lane soon and is ``hindered`` [N, K, 1]."""
    brakes = ways.asks & scene.observers.valid & hindered[..., 0]
    return torch.where(brakes, -mobil.courtesy, torch.inf)


def yielding(scene: Scene, idm: AnyIdm, mobil: MobilParameters) -> Tensor:
    """Acceleration with which every driver makes room, m/s2, [N, M]; infinite where none is needed.

    It follows the nearest vehicle ahead that has to change into its lane from one beside it, as if
    that were its leader already, but brakes for it no harder than ``courtesy``. Who has to change
    falls behind likewise (:func:`falling_behind`).

    Of two who are in each other's way only the one behind makes room; and one that is nearer than
    half of IDM's least gap goes past, since nobody would change in front of it. So they cannot
    block one another.

    Args:
        scene: with all vehicles as observers.
    """
    vehicles = scene.vehicles
    ways = ways_out(vehicles, scene.road, mobil.mandatory_m)
    asks = vehicles.valid & ways.asks
    nobody_asks = reads_are_cheap(asks) and not bool(asks.any())
    if mobil.courtesy == 0.0 or nobody_asks:
        return torch.full_like(vehicles.x, torch.inf)

    # [N, i, j]: j is ahead of i, and asks for the lane that i keeps.
    pairs = scene.pairs
    wanted = vehicles.target_lane + ways.side
    into_its_lane = wanted[:, None, :] == vehicles.target_lane[:, :, None]
    ahead = asks[:, None, :] & into_its_lane & (pairs.order > 0)

    # The nearest of them, [N, M, 1]; of two at the same gap the slower one counts.
    gaps = torch.where(ahead, pairs.gap, torch.inf)
    gap = gaps.amin(-1, keepdim=True)
    speeds = torch.where(ahead & (gaps == gap), vehicles.speed[:, None, :], torch.inf)
    slowest = speeds.amin(-1, keepdim=True)

    # IDM needs finite numbers where there is none, or where one is too near to change.
    exists = torch.isfinite(gap) & (gap > 0.5 * idm.min_gap_m)
    speed = vehicles.speed[..., None]
    desired = vehicles.desired_speed[..., None]
    gap = torch.where(exists, gap, FREE_GAP_M).clamp_max(FREE_GAP_M)
    slowest = torch.where(exists, slowest, 0.0)
    acceleration = idm_acceleration(speed, desired, gap, slowest, idm.per_lane())
    makes_room = torch.where(exists, acceleration, torch.inf).clamp_min(-mobil.courtesy)[..., 0]

    falls_behind = falling_behind(scene, ways, idm, mobil)
    return torch.minimum(makes_room, falls_behind)


def mobil_wishes(
    scene: Scene,
    idm: AnyIdm = TABLE_V,
    mobil: MobilParameters = TABLE_IV,
    politeness: Tensor | float = 1.0,
) -> Tensor:
    """Lane change that MOBIL proposes to each driver: -1 right, 0 none, +1 left, int64 [N, K].

    None during a lane change. If both sides qualify, the one with the larger incentive, left if
    equal. Where lanes end, nobody changes into a lane that it has to leave more urgently.

    Args:
        scene: [N, K] observers.
        idm: of all drivers, or of each (:class:`~ganlane.sim.idm.DriverIdm`).
        mobil: of all drivers.
        politeness: as of :func:`mobil_criterion`.
    """
    vehicles = scene.observers
    lane = vehicles.target_lane.to(vehicles.x.dtype)[..., None]

    # Own lane first, then left and right, [N, K, 3]; all three in one search.
    lanes = lane + constant((0.0, 1.0, -1.0), lane)
    accelerations = lane_accelerations(scene, lanes, idm)
    here = accelerations.of(slice(0, 1))
    there = accelerations.of(slice(1, None))

    # Of the two changes, [N, K, 2].
    incentive, safe = mobil_criterion(there, here, mobil, politeness)
    sides = lanes[..., 1:] - lane
    possible = may_change(scene.road, lane, sides, vehicles.x[..., None])
    if scene.road.has_lane_ends:
        # How much the driver wants to leave its lane, and the two beside it.
        leave = bias(scene.road, lanes, vehicles.x, mobil.mandatory_bias, mobil.mandatory_m)
        its = leave[..., :1]
        beside = leave[..., 1:]
        incentive = incentive + torch.where(its > beside, its, 0.0)
        possible = possible & (its >= beside)
    pays = possible & safe & (incentive > mobil.threshold)

    # The better side, [N, K].
    left, right = torch.where(pays, incentive, -torch.inf).unbind(-1)
    side = torch.where(left >= right, 1, -1)

    # A driver decides anew only when its last change is complete.
    free = lane_change_done(vehicles, scene.road) & vehicles.valid
    one_pays = torch.isfinite(torch.maximum(left, right))
    return torch.where(free & one_pays, side, 0)


def mobil_changes(
    scene: Scene,
    idm: AnyIdm = TABLE_V,
    mobil: MobilParameters = TABLE_IV,
    politeness: Tensor | float = 1.0,
) -> Tensor:
    """Lane change that each driver starts, -1, 0 or +1, int64 [N, M].

    :func:`mobil_wishes` filtered by :func:`one_at_a_time`. The ego (vehicle 0) is controlled by the
    agent: its column is 0, and it blocks no other change.
    """
    wish = without_ego(mobil_wishes(scene, idm, mobil, politeness))
    return one_at_a_time(scene, wish, idm, mobil)
