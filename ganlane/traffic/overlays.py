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

    ``clock`` is the number of steps since the last one ended, ``mean_steps`` is ``t_m``.
    Read literally the probability grows until a change is certain at ``t = t_m``, so the mean
    waiting time is about ``sqrt(pi t_m / 2)`` steps, not ``t_m``.
    """
    return (clock / mean_steps).clamp(0.0, 1.0)


def random_side(u: Tensor, lane: Tensor, lanes: int | Tensor) -> Tensor:
    """A random side with a lane: -1 right, +1 left, 0 on a single-lane road.

    ``u`` uniform in [0, 1), ``lane`` int64 from 0 on the right, of the same shape.
    """
    return _one_of(u, lane < lanes - 1, lane > 0)


def _one_of(u: Tensor, left: Tensor, right: Tensor) -> Tensor:
    """A random one of the sides that are free."""
    # Drawn for everybody, used where there is a lane on both sides.
    both = torch.where(u < 0.5, 1, -1)
    return torch.where(left & right, both, torch.where(left, 1, torch.where(right, -1, 0)))


def _side(
    vehicles: Vehicles, road: Road, u: Tensor, mobil: MobilParameters
) -> tuple[Tensor, WaysOut | None]:
    """As :func:`random_side`; where lanes end the side to which a driver has to go, if there is
    one, and all ways out.
    """
    if not road.stretches:
        return random_side(u, vehicles.target_lane, road.lanes), None
    ways = ways_out(vehicles, road, mobil.mandatory_m)
    free = _one_of(u, ways.left, ways.right)
    return torch.where(ways.side != 0, ways.side, free), ways


class LiteralLaneChange(Overlay):
    """The paper's lane changes: hazard ``t / t_m`` per step, blind, at a lateral speed drawn per
    change (equation 10).

    Memory: ``clock``, steps since the last change ended (0 at the start, too), and
    ``lateral_speed`` of the current change (m/s, positive to the left, 0 without one).
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
        self, vehicles: Vehicles, moved: Vehicles, memory: Memory, key: Tensor, step: Tensor
    ) -> Moved:
        """Start changes, and move current ones sideways at their own speed until they arrive.

        A vehicle whose target lane was set back (:class:`ganlane.traffic.AbortedLaneChange`)
        returns at that speed.
        """
        c = self.changes
        dtype = vehicles.x.dtype
        u, u_side = uniforms(vehicles, key, step, *_CHANGE)
        gauss = normal(key, step, vehicles.x.shape[1], [Purpose.LANE_CHANGE_SPEED], dtype)[..., 0]

        # Blind: nobody looks for a gap, as in the paper.
        hazard = literal_hazard(memory["clock"].to(dtype), c.mean_steps)
        side, ways = _side(vehicles, self.road, u_side, self.mobil)
        if ways is not None:
            hazard = torch.maximum(hazard, ways.urgency)
        starts = (memory["lateral_speed"] == 0) & vehicles.valid & (u < hazard)
        side = torch.where(starts, side, 0)
        target = vehicles.target_lane + side

        # One lateral speed for the whole change.
        drawn = (c.lateral_speed_mps + c.lateral_speed_sd_mps * gauss).clamp_min(c.slowest_mps)
        pace = torch.where(side != 0, drawn, memory["lateral_speed"].abs())
        changing = pace != 0

        # Towards the target lane, which may have been set back meanwhile.
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

        # 0 during a change; it counts from the end of the change.
        clock = torch.where(changing, 0, memory["clock"] + 1)
        return moved, {
            "clock": clock,
            # 0 means that no change is going on.
            "lateral_speed": torch.where(arrives, 0.0, lateral),
        }


class CalibratedLaneChange(Overlay):
    """Lane changes at the recorded rate, after a gap check that considers closing speeds.

    Only the target lane is set: the model below drives there. A driver wishes for a side at a
    constant rate per kilometre, waits for a gap, and gives up after a while.

    Memory: ``wish``, the desired side (-1, 0, 1), and ``waited``, the number of steps since it
    began.
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
        """The current wish, or a new one: a side [N, M], -1 right, 0 none, 1 left."""
        u, u_side = uniforms(vehicles, key, step, *_CHANGE)
        # At a constant rate per kilometre driven: the probability of at least one event of a
        # Poisson process within the step.
        comes = u < 1.0 - torch.exp(-vehicles.speed * (self.dt * self.changes.per_km / 1000.0))

        side, ways = _side(vehicles, self.road, u_side, self.mobil)
        # Who is still changing does not wish for another change.
        free = lane_change_done(vehicles, self.road) & vehicles.valid
        new = torch.where(comes & free, side, 0)
        wish = torch.where(memory["wish"] != 0, memory["wish"], new)
        if ways is not None:
            # Where lanes end, the side that one has to go to comes before what one would like.
            wish = torch.where(free & (ways.side != 0), ways.side, wish)
            there = torch.where(wish > 0, ways.left, ways.right)
            wish = torch.where(there, wish, 0)
        return without_ego(wish)

    def _contested(self, scene: Scene, lane: Tensor) -> Tensor:
        """Whether a near vehicle other than the ego is already moving into ``lane`` [N, M]."""
        vehicles = scene.vehicles
        pairs = scene.pairs
        target = vehicles.target_lane.to(lane.dtype)
        # Without the ego, whose intention the others do not know.
        elsewhere = self.road.lane_of(vehicles.y) != target
        changing = without_ego(elsewhere & vehicles.valid)

        # Pairs [N, M, M]: a driver, and who may contest its lane.
        near = torch.minimum(pairs.ahead, pairs.behind) < self.changes.exclusive_m
        same_lane = target[:, None, :] == lane[:, :, None]
        return (near & changing[:, None, :] & same_lane).any(-1)

    def rewrite(
        self, vehicles: Vehicles, moved: Vehicles, memory: Memory, key: Tensor, step: Tensor
    ) -> Moved:
        """Set the target lane of those whose wish finds a gap."""
        wish = self._wishes(vehicles, memory, key, step)
        scene = perceive(vehicles, self.road)

        # As floats, since the lanes of an absent vehicle are infinite.
        lane = (vehicles.target_lane + wish).to(vehicles.x.dtype)

        # Neither the driver nor its new follower has to brake harder than the limit, by IDM.
        safe = safe_change(scene, lane, self.idm, self._limits)
        wanted = torch.where(safe & ~self._contested(scene, lane), wish, 0)
        # Two that would start into the same gap at once cannot see each other's intention.
        starts = one_at_a_time(scene, wanted, self.idm, self._limits)

        # Steps since the wish began.
        waited = torch.where(wish != 0, memory["waited"] + 1, 0)
        # Otherwise wishes pile up in dense traffic and all come true when it thins out.
        gives_up = waited >= round(self.changes.patience_s / self.dt)
        rest = torch.where((starts != 0) | gives_up, 0, wish)
        moved = moved.with_(target_lane=vehicles.target_lane + starts)
        return moved, {"wish": rest, "waited": torch.where(rest == 0, 0, waited)}


def _accelerated(
    vehicles: Vehicles, moved: Vehicles, who: Tensor, acceleration: Tensor, dt: float
) -> Vehicles:
    """``moved``, where ``who`` [N, M] drives along the road at ``acceleration``, m/s2."""
    speed = (vehicles.speed + acceleration * dt).clamp_min(0.0)
    return moved.with_(
        speed=torch.where(who, speed, moved.speed),
        # As realised, not as asked for: braking ends at a standstill.
        acceleration=torch.where(who, (speed - vehicles.speed) / dt, moved.acceleration),
        x=torch.where(who, vehicles.x + 0.5 * (vehicles.speed + speed) * dt, moved.x),
    )


class AccelerationOverlay(Overlay):
    """The paper's 'instant-acceleration or instant-slowing', drawn from the recorded accelerations.

    The paper says that accelerations 'were added manually' and no more. Here they come at a
    constant hazard and replace the base model's acceleration for a second. Memory: the acceleration
    (m/s2) and its remaining steps.
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
        self, vehicles: Vehicles, moved: Vehicles, memory: Memory, key: Tensor, step: Tensor
    ) -> Moved:
        """Replace speed and position along the road during a sudden acceleration."""
        s = self.sudden
        m = vehicles.x.shape[1]
        dtype = vehicles.x.dtype
        (u,) = uniforms(vehicles, key, step, Purpose.ACCELERATION)
        gauss = normal(key, step, m, [Purpose.ACCELERATION], dtype)[..., 0]

        # A constant hazard while none is going on.
        # For short steps dt / every_s is the probability within one.
        starts = (memory["left"] == 0) & (u < self.dt / s.every_s) & vehicles.valid
        acceleration = torch.where(starts, s.mean + s.sd * gauss, memory["acceleration"])
        # Steps that remain, this one included.
        left = torch.where(starts, round(s.lasts_s / self.dt), memory["left"])
        moved = _accelerated(vehicles, moved, left > 0, acceleration, self.dt)
        return moved, {"acceleration": acceleration, "left": (left - 1).clamp_min(0)}


class Guard(Overlay):
    """Bound the acceleration, pull towards the target lane, keep the body on the road.

    The acceleration of IDM is the lower bound, less a slack that grows with the speed; the upper
    one is IDM's at a shorter headway. Without memory.
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
        """``moved`` with its acceleration between the bounds by IDM."""
        g = self.guard
        # With the new target lane: the guard also looks where the change goes.
        scene = perceive(vehicles.with_(target_lane=moved.target_lane), self.road)
        lanes = spanned(scene.attention)
        ahead = leader(scene, lanes)

        # Bounds [N, M], m/s2.
        highest = acceleration_in(scene, lanes, ahead, self.closest)
        lowest = acceleration_in(scene, lanes, ahead, self.idm)
        lowest = lowest - g.slack * vehicles.speed / vehicles.desired_speed
        highest, lowest = (bound.clamp_min(g.hardest_braking) for bound in (highest, lowest))

        # What the chain made of it, whichever part moved the vehicle.
        wanted = (moved.speed - vehicles.speed) / self.dt
        # Where the bounds cross, the upper one holds: keeping off the leader comes first.
        acceleration = wanted.clamp(lowest, highest)
        # Who is within the bounds moves bit for bit as the chain says.
        return _accelerated(vehicles, moved, acceleration != wanted, acceleration, self.dt)

    def across(self, vehicles: Vehicles, moved: Vehicles) -> Vehicles:
        """``moved`` pulled towards its lane's centre, and kept inside the edges of the road.

        It is pulled only where it keeps a lane.
        """
        g = self.guard
        road = self.road
        offset = road.centre_of(moved.target_lane, moved.y.dtype) - vehicles.y

        # PD: keep a share of the lateral motion, and add a pull to the centre.
        damped = vehicles.y + g.damping * (moved.y - vehicles.y)
        pulled = damped + g.centring_per_s * self.dt * offset
        y = torch.where(offset.abs() < 0.5 * road.lane_width_m, pulled, moved.y)

        # First the edges for a straight body; the heading of a turned one is bounded below.
        half = 0.5 * moved.width
        left = road.left_edge_m() - g.edge_margin_m
        right = road.right_edge_m() + g.edge_margin_m
        y = y.clamp(right + half, left - half)

        # A standing vehicle has no direction of its own, so the divisor is bounded.
        heading = torch.atan((y - vehicles.y) / ((moved.x - vehicles.x).clamp_min(0.1)))
        heading = torch.where(y == moved.y, moved.heading, heading)

        # A turned body is wider by half its length times the sine, which the angle exceeds.
        room = torch.minimum(left - y, y - right) - half
        steepest = (room / (0.5 * moved.length)).clamp(0.0, g.steepest_rad)
        return moved.with_(y=y, heading=heading.clamp(-steepest, steepest))

    def rewrite(
        self, vehicles: Vehicles, moved: Vehicles, memory: Memory, key: Tensor, step: Tensor
    ) -> Moved:
        """Along the road, then across it."""
        return self.across(vehicles, self.along(vehicles, moved)), memory
