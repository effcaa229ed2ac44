"""Laid over a traffic model: lane changes, sudden accelerations, and the guard.

The first are what the paper adds to its generated traffic, and a calibrated form of it. The guard
keeps generated vehicles on the road, in their lanes and off their leaders' bumpers: a network with
relative positions as its only input drifts off the road within a minute, and to any speed.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ganlane.settings.driving import IdmParameters, MobilParameters
from ganlane.settings.generated import (
    CalibratedChanges,
    GuardParameters,
    LiteralChanges,
    SuddenAccelerations,
)
from ganlane.sim.idm import TABLE_V, acceleration_in
from ganlane.sim.lane_ends import WaysOut, ways_out
from ganlane.sim.mobil import TABLE_IV, one_at_a_time, safe_change, without_ego
from ganlane.sim.neighbours import Scene, leader, perceive
from ganlane.sim.random import Purpose, Stream, normal
from ganlane.sim.state import Road, Vehicles, lane_change_done, spanned
from ganlane.traffic.base import Memory, Moved, Overlay, uniforms

#: Random numbers of a lane change: whether it starts, and to which side.
_CHANGE = (Purpose.LANE_CHANGE_HAZARD, Purpose.LANE_CHANGE_SIDE)


def literal_hazard(clock: Tensor, mean_steps: float) -> Tensor:
    """Equation 10: probability ``t / t_m`` per step of a change.

    Read literally the probability grows until a change is certain at ``t = t_m``, so the mean
    waiting time is about ``sqrt(pi t_m / 2)`` steps, not ``t_m``.

    Args:
        clock: ``t``, steps since the last change ended, [N, M].
        mean_steps: ``t_m``.
    """
    return (clock / mean_steps).clamp(0.0, 1.0)


def random_side(u: Tensor, lane: Tensor, lanes: int | Tensor) -> Tensor:
    """A random side with a lane: -1 right, +1 left, 0 on a single-lane road.

    Args:
        u: uniform in [0, 1).
        lane: int64 from 0 on the right, of the same shape.
        lanes: of the road.
    """
    has_left = lane < lanes - 1
    has_right = lane > 0
    return _one_of(u, has_left, has_right)


def _one_of(u: Tensor, left: Tensor, right: Tensor) -> Tensor:
    """A random one of the sides that are free: 1 left, -1 right, 0 if none is."""
    only_one = torch.where(left, 1, torch.where(right, -1, 0))
    # Drawn for everybody, used where there is a lane on both sides.
    drawn = torch.where(u < 0.5, 1, -1)
    return torch.where(left & right, drawn, only_one)


def _side(
    vehicles: Vehicles, road: Road, u: Tensor, mobil: MobilParameters
) -> tuple[Tensor, WaysOut | None]:
    """The side to which each driver would change.

    Returns:
        As :func:`random_side`, but where lanes end the side to which a driver has to go, if there
        is one; and all ways out, None on a road whose lanes go on.
    """
    if not road.stretches:
        return random_side(u, vehicles.target_lane, road.lanes), None
    ways = ways_out(vehicles, road, mobil.mandatory_m)
    by_choice = _one_of(u, ways.left, ways.right)
    return torch.where(ways.side != 0, ways.side, by_choice), ways


class LiteralLaneChange(Overlay):
    """The paper's lane changes: hazard ``t / t_m`` per step, blind, at a lateral speed drawn per
    change (equation 10).

    Memory: ``clock``, steps since the last change ended (0 at the start, too), and
    ``lateral_speed`` of the current change (m/s, positive to the left, 0 without one).

    Args:
        road, stream: as for every traffic module.
        changes: how often, and how fast.
        mobil: how drivers leave a lane that ends.
    """

    memory_fields = {  # noqa: RUF012
        "clock": ((), torch.int64),
        "lateral_speed": ((), None),
    }

    def __init__(
        self,
        road: Road | None = None,
        stream: int = Stream.TRAIN,
        changes: LiteralChanges | None = None,
        mobil: MobilParameters = TABLE_IV,
    ) -> None:
        super().__init__(road, stream)
        self.changes = changes or LiteralChanges()
        self.mobil = mobil

    def rewrite(
        self,
        vehicles: Vehicles,
        moved: Vehicles,
        memory: Memory,
        key: Tensor,
        step: Tensor,
    ) -> Moved:
        """Start changes, and move current ones sideways at their own speed until they arrive.

        A vehicle whose target lane was set back (:class:`ganlane.traffic.AbortedLaneChange`)
        returns at that speed.
        """
        changes = self.changes
        count = vehicles.x.shape[1]
        dtype = vehicles.x.dtype
        u, u_side = uniforms(vehicles, key, step, *_CHANGE)
        gauss = normal(key, step, count, [Purpose.LANE_CHANGE_SPEED], dtype)[..., 0]

        # Blind: nobody looks for a gap, as in the paper.
        hazard = literal_hazard(memory["clock"].to(dtype), changes.mean_steps)
        side, ways = _side(vehicles, self.road, u_side, self.mobil)
        if ways is not None:
            # The nearer the end of a lane is, the sooner its drivers leave it.
            hazard = torch.maximum(hazard, ways.urgency)
        no_change = memory["lateral_speed"] == 0
        starts = no_change & vehicles.valid & (u < hazard)
        side = torch.where(starts, side, 0)
        target = vehicles.target_lane + side

        # One lateral speed, m/s, for the whole change.
        drawn = changes.lateral_speed_mps + changes.lateral_speed_sd_mps * gauss
        drawn = drawn.clamp_min(changes.slowest_mps)
        pace = torch.where(side != 0, drawn, memory["lateral_speed"].abs())
        changing = pace != 0

        # Towards the target lane, which may have been set back meanwhile: the way left, m.
        remaining = self.road.centre_of(target, vehicles.y.dtype) - vehicles.y
        lateral = torch.copysign(pace, remaining)

        # The last step ends at the lane's centre, not beyond it.
        stride = lateral * self.dt
        arrives = changing & (remaining.abs() <= stride.abs())
        y = vehicles.y + torch.where(arrives, remaining, stride)

        # Below 1 m/s the angle would grow without bound.
        heading = torch.atan(lateral / vehicles.speed.clamp_min(1.0))
        moved = moved.with_(
            target_lane=target,
            y=torch.where(changing, y, moved.y),
            heading=torch.where(changing, heading, moved.heading),
        )

        new_memory = {
            # 0 during a change; it counts from the end of the change.
            "clock": torch.where(changing, 0, memory["clock"] + 1),
            # 0 means that no change is going on.
            "lateral_speed": torch.where(arrives, 0.0, lateral),
        }
        return moved, new_memory


class CalibratedLaneChange(Overlay):
    """Lane changes at the recorded rate, after a gap check that considers closing speeds.

    Only the target lane is set: the model below drives there. A driver wishes for a side at a
    constant rate per kilometre, waits for a gap, and gives up after a while.

    Memory: ``wish``, the desired side (-1, 0, 1), and ``waited``, the number of steps since it
    began.

    Args:
        road, stream: as for every traffic module.
        changes: how often, how long a driver waits, and how hard a change may make one brake.
        idm: by which the gap check expects drivers to brake.
        mobil: how drivers leave a lane that ends.
    """

    memory_fields = {  # noqa: RUF012
        "wish": ((), torch.int64),
        "waited": ((), torch.int64),
    }

    def __init__(
        self,
        road: Road | None = None,
        stream: int = Stream.TRAIN,
        changes: CalibratedChanges | None = None,
        idm: IdmParameters = TABLE_V,
        mobil: MobilParameters = TABLE_IV,
    ) -> None:
        super().__init__(road, stream)
        self.changes = changes or CalibratedChanges()
        self.idm = idm
        self.mobil = mobil
        self._limits = self.changes.limits()

    def _wishes(self, vehicles: Vehicles, memory: Memory, key: Tensor, step: Tensor) -> Tensor:
        """The current wish, or a new one: a side [N, M], -1 right, 0 none, 1 left.

        The ego has none: what it does is not this model's.
        """
        u, u_side = uniforms(vehicles, key, step, *_CHANGE)

        # At a constant rate per kilometre driven: the probability of at least one event of a
        # Poisson process within the step.
        per_mps = self.dt * self.changes.per_km / 1000.0
        comes = u < 1.0 - torch.exp(-vehicles.speed * per_mps)

        side, ways = _side(vehicles, self.road, u_side, self.mobil)
        # Who is still changing does not wish for another change.
        free = lane_change_done(vehicles, self.road) & vehicles.valid
        new = torch.where(comes & free, side, 0)
        wish = torch.where(memory["wish"] != 0, memory["wish"], new)

        if ways is not None:
            # Where lanes end, the side that one has to go to comes before what one would like.
            wish = torch.where(free & (ways.side != 0), ways.side, wish)
            # A lane may have ended since the wish began.
            there = torch.where(wish > 0, ways.left, ways.right)
            wish = torch.where(there, wish, 0)
        return without_ego(wish)

    def _contested(self, scene: Scene, lane: Tensor) -> Tensor:
        """Whether a near vehicle other than the ego is already moving into a driver's new lane.

        Args:
            scene: at t.
            lane: that each driver would change to, [N, M] float.

        Returns:
            bool [N, M].
        """
        vehicles = scene.vehicles
        pairs = scene.pairs

        # Without the ego, whose intention the others do not know.
        target = vehicles.target_lane.to(lane.dtype)
        elsewhere = self.road.lane_of(vehicles.y) != target
        changing = without_ego(elsewhere & vehicles.valid)

        # Pairs [N, M, M]: a driver, and who may contest its lane. Of the two gaps, ahead and
        # behind, the smaller one counts.
        near = torch.minimum(pairs.ahead, pairs.behind) < self.changes.exclusive_m
        same_lane = target[:, None, :] == lane[:, :, None]
        return (near & changing[:, None, :] & same_lane).any(-1)

    def rewrite(
        self,
        vehicles: Vehicles,
        moved: Vehicles,
        memory: Memory,
        key: Tensor,
        step: Tensor,
    ) -> Moved:
        """Set the target lane of those whose wish finds a gap."""
        wish = self._wishes(vehicles, memory, key, step)
        scene = perceive(vehicles, self.road)

        # As floats, since the lanes of an absent vehicle are infinite.
        lane = (vehicles.target_lane + wish).to(vehicles.x.dtype)

        # Neither the driver nor its new follower has to brake harder than the limit, by IDM.
        safe = safe_change(scene, lane, self.idm, self._limits)
        contested = self._contested(scene, lane)
        wanted = torch.where(safe & ~contested, wish, 0)
        # Two that would start into the same gap at once cannot see each other's intention.
        starts = one_at_a_time(scene, wanted, self.idm, self._limits)
        moved = moved.with_(target_lane=vehicles.target_lane + starts)

        # Steps since the wish began.
        waited = torch.where(wish != 0, memory["waited"] + 1, 0)
        # Otherwise wishes pile up in dense traffic and all come true when it thins out.
        patience_steps = round(self.changes.patience_s / self.dt)
        gives_up = waited >= patience_steps
        remaining_wish = torch.where((starts != 0) | gives_up, 0, wish)
        new_memory = {
            "wish": remaining_wish,
            "waited": torch.where(remaining_wish == 0, 0, waited),
        }
        return moved, new_memory


def _accelerated(
    vehicles: Vehicles,
    moved: Vehicles,
    who: Tensor,
    acceleration: Tensor,
    dt: float,
) -> Vehicles:
    """``moved``, where ``who`` drives along the road at another acceleration.

    Args:
        vehicles: at t.
        moved: at t + ``dt``, s.
        who: bool [N, M]; the others stay as they are in ``moved``.
        acceleration: m/s2, [N, M].
        dt: length of the step, s.
    """
    speed = (vehicles.speed + acceleration * dt).clamp_min(0.0)
    # As realised, not as asked for: braking ends at a standstill.
    realised = (speed - vehicles.speed) / dt
    # At the mean of both speeds.
    x = vehicles.x + 0.5 * (vehicles.speed + speed) * dt
    return moved.with_(
        speed=torch.where(who, speed, moved.speed),
        acceleration=torch.where(who, realised, moved.acceleration),
        x=torch.where(who, x, moved.x),
    )


class AccelerationOverlay(Overlay):
    """The paper's 'instant-acceleration or instant-slowing', drawn from the recorded accelerations.

    The paper says that accelerations 'were added manually' and no more. Here they come at a
    constant hazard and replace the base model's acceleration for a second.

    Memory: ``acceleration`` (m/s2) and ``left``, its remaining steps.

    Args:
        road, stream: as for every traffic module.
        sudden: how often they come, how long they last, and their distribution.
    """

    memory_fields = {  # noqa: RUF012
        "acceleration": ((), None),
        "left": ((), torch.int64),
    }

    def __init__(
        self,
        road: Road | None = None,
        stream: int = Stream.TRAIN,
        sudden: SuddenAccelerations | None = None,
    ) -> None:
        super().__init__(road, stream)
        self.sudden = sudden or SuddenAccelerations()

    def rewrite(
        self,
        vehicles: Vehicles,
        moved: Vehicles,
        memory: Memory,
        key: Tensor,
        step: Tensor,
    ) -> Moved:
        """Replace speed and position along the road during a sudden acceleration."""
        sudden = self.sudden
        count = vehicles.x.shape[1]
        dtype = vehicles.x.dtype
        (u,) = uniforms(vehicles, key, step, Purpose.ACCELERATION)
        gauss = normal(key, step, count, [Purpose.ACCELERATION], dtype)[..., 0]

        # A constant hazard while none is going on.
        # For short steps dt / every_s is the probability within one.
        comes = u < self.dt / sudden.every_s
        starts = (memory["left"] == 0) & comes & vehicles.valid
        drawn = sudden.mean + sudden.sd * gauss
        acceleration = torch.where(starts, drawn, memory["acceleration"])

        # Steps that remain, this one included.
        left = torch.where(starts, round(sudden.lasts_s / self.dt), memory["left"])
        moved = _accelerated(vehicles, moved, left > 0, acceleration, self.dt)
        new_memory = {
            "acceleration": acceleration,
            "left": (left - 1).clamp_min(0),
        }
        return moved, new_memory


class Guard(Overlay):
    """Bound the acceleration, pull towards the target lane, keep the body on the road.

    The acceleration of IDM is the lower bound, less a slack that grows with the speed; the upper
    one is IDM's at a shorter headway. Without memory.

    Args:
        road, stream: as for every traffic module.
        guard: its strengths and margins.
        idm: of the bounds on the acceleration.
    """

    def __init__(
        self,
        road: Road | None = None,
        stream: int = Stream.TRAIN,
        guard: GuardParameters | None = None,
        idm: IdmParameters = TABLE_V,
    ) -> None:
        super().__init__(road, stream)
        self.guard = guard or GuardParameters()
        self.idm = idm
        # A shorter headway than IDM's: the network may follow more closely than the model would.
        self.closest = replace(idm, headway_s=self.guard.headway_s)

    def along(self, vehicles: Vehicles, moved: Vehicles) -> Vehicles:
        """``moved`` with its acceleration between the bounds by IDM.

        Who is within them moves bit for bit as the parts before the guard say.
        """
        guard = self.guard
        # With the new target lane: the guard also looks where the change goes.
        scene = perceive(vehicles.with_(target_lane=moved.target_lane), self.road)
        lanes = spanned(scene.attention)
        ahead = leader(scene, lanes)

        # Bounds [N, M], m/s2.
        highest = acceleration_in(scene, lanes, ahead, self.closest)
        highest = highest.clamp_min(guard.hardest_braking)
        lowest = acceleration_in(scene, lanes, ahead, self.idm)
        lowest = lowest - guard.slack * vehicles.speed / vehicles.desired_speed
        lowest = lowest.clamp_min(guard.hardest_braking)

        # What the chain made of it, whichever part moved the vehicle.
        wanted = (moved.speed - vehicles.speed) / self.dt
        # Where the bounds cross, the upper one holds: keeping off the leader comes first.
        acceleration = wanted.clamp(lowest, highest)
        is_bounded = acceleration != wanted
        return _accelerated(vehicles, moved, is_bounded, acceleration, self.dt)

    def across(self, vehicles: Vehicles, moved: Vehicles) -> Vehicles:
        """``moved`` pulled towards its lane's centre, and kept inside the edges of the road.

        It is pulled only where it keeps a lane.
        """
        guard = self.guard
        road = self.road
        # From the vehicle to the centre of its lane, m.
        offset = road.centre_of(moved.target_lane, moved.y.dtype) - vehicles.y

        # PD: keep a share of the lateral motion, and add a pull to the centre.
        damped = vehicles.y + guard.damping * (moved.y - vehicles.y)
        pulled = damped + guard.centring_per_s * self.dt * offset
        keeps_lane = offset.abs() < 0.5 * road.lane_width_m
        y = torch.where(keeps_lane, pulled, moved.y)

        # First the edges for a straight body; the heading of a turned one is bounded below.
        half_width = 0.5 * moved.width
        left = road.left_edge_m() - guard.edge_margin_m
        right = road.right_edge_m() + guard.edge_margin_m
        y = y.clamp(right + half_width, left - half_width)

        # A standing vehicle has no direction of its own, so the divisor is bounded.
        dx = (moved.x - vehicles.x).clamp_min(0.1)
        heading = torch.atan((y - vehicles.y) / dx)
        heading = torch.where(y == moved.y, moved.heading, heading)

        # A turned body is wider by half its length times the sine, which the angle exceeds.
        room = torch.minimum(left - y, y - right) - half_width
        steepest = room / (0.5 * moved.length)
        steepest = steepest.clamp(0.0, guard.steepest_rad)
        return moved.with_(y=y, heading=heading.clamp(-steepest, steepest))

    def rewrite(
        self,
        vehicles: Vehicles,
        moved: Vehicles,
        memory: Memory,
        key: Tensor,
        step: Tensor,
    ) -> Moved:
        """Along the road, then across it."""
        moved = self.along(vehicles, moved)
        moved = self.across(vehicles, moved)
        return moved, memory
