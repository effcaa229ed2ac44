"""Faults of drivers, as overlays: phantom braking, late reactions, faulty lane changes.

Each fault is a module of its own, comes at random to single drivers (never to the ego), and leaves
the others bitwise as they were moved. The faults of lane changes need a model below that moves
towards ``vehicles.target_lane``, as every model that ships does.
"""

from __future__ import annotations

from typing import Generic, TypeVar

import torch
from torch import Tensor

from ganlane.native.drivers import chance_in_step, faulty_drivers
from ganlane.settings.driving import (
    AbortFaults,
    BrakingFaults,
    DriverFaults,
    HesitationFaults,
    ReactionFaults,
)
from ganlane.sim.random import Purpose, Stream
from ganlane.sim.state import Road, Vehicles, lane_change_done
from ganlane.traffic.base import Memory, Moved, Overlay, TrafficModule, TrafficSequential, uniforms
from ganlane.traffic.idm_mobil import IdmMobilTraffic

#: A step shorter than this has no direction of its own, m: the vehicle then moves along its
#: heading.
_SHORTEST_M = 1e-3
#: No lane to turn back to.
_NO_LANE = -1
Faults = TypeVar("Faults")
Timed = TypeVar("Timed", bound=BrakingFaults | ReactionFaults)


def other_drivers(vehicles: Vehicles) -> Tensor:
    """Valid non-ego vehicles, bool [N, M]."""
    # The ego's motion is the environment's, so a fault of it would have no effect.
    return vehicles.valid & ~vehicles.is_ego()


def starting(vehicles: Vehicles, moved: Vehicles) -> Tensor:
    """Drivers whose lane change the model below has just begun, bool [N, M]."""
    return (moved.target_lane != vehicles.target_lane) & other_drivers(vehicles)


def driven_at(vehicles: Vehicles, moved: Vehicles, acceleration: Tensor, dt: float) -> Vehicles:
    """``moved`` with another ``acceleration`` (m/s2, [N, M]): the same path, slower or faster.

    Position and heading follow the path from ``vehicles`` to ``moved`` in proportion to the
    distance driven.
    """
    speed = (vehicles.speed + acceleration * dt).clamp_min(0.0)
    # Trapezoids, as in dynamics.advance: the distance that the model drives, then this one, m.
    usual = 0.5 * (vehicles.speed + moved.speed) * dt
    distance = 0.5 * (vehicles.speed + speed) * dt
    # How much of the usual step is driven.
    share = distance / usual.clamp_min(_SHORTEST_M)

    # A standing vehicle that moves off has no path to follow yet, and its share means nothing: it
    # goes straight on.
    has_path = usual > _SHORTEST_M
    straight_x = distance * torch.cos(vehicles.heading)
    straight_y = distance * torch.sin(vehicles.heading)
    dx = torch.where(has_path, share * (moved.x - vehicles.x), straight_x)
    dy = torch.where(has_path, share * (moved.y - vehicles.y), straight_y)
    turn = torch.where(has_path, share * (moved.heading - vehicles.heading), 0.0)
    return moved.with_(
        x=vehicles.x + dx,
        y=vehicles.y + dy,
        heading=vehicles.heading + turn,
        speed=speed,
        acceleration=(speed - vehicles.speed) / dt,
    )


class Fault(Overlay, Generic[Faults]):
    """A fault that comes at random, as often as its ``faults`` say.

    Args:
        road, stream: as for every traffic module.
        faults: how often, and how bad; None: those of :attr:`kind`'s defaults.

    Attributes:
        kind: the record of ``faults``.
        purpose: that of its random numbers.
    """

    kind: type[Faults]
    purpose: Purpose

    def __init__(
        self, road: Road | None = None, stream: int = Stream.TRAIN, faults: Faults | None = None
    ) -> None:
        super().__init__(road, stream)
        self.faults: Faults = faults or self.kind()


class TimedFault(Fault[Timed]):
    """A fault that lasts. Memory: ``left``, its remaining steps."""

    def steps_left(self, left: Tensor, vehicles: Vehicles, key: Tensor, step: Tensor) -> Tensor:
        """``left`` [N, M] int64, or all steps of a fault that begins now.

        A fault begins where there is none, at a constant hazard.
        """
        (u,) = uniforms(vehicles, key, step, self.purpose)
        comes = u < chance_in_step(self.faults.per_hour)
        # A fault that lasts is not prolonged by a second one.
        begins = (left == 0) & other_drivers(vehicles) & comes
        all_steps = round(self.faults.lasts_s / self.dt)
        return torch.where(begins, all_steps, left)


class PhantomBraking(TimedFault[BrakingFaults]):
    """At times a driver brakes without a reason. Memory: the remaining steps of braking."""

    memory_fields = {"left": ((), torch.int64)}  # noqa: RUF012
    kind = BrakingFaults
    purpose = Purpose.FAULT

    def rewrite(
        self,
        vehicles: Vehicles,
        moved: Vehicles,
        memory: Memory,
        key: Tensor,
        step: Tensor,
    ) -> Moved:
        """Brake during a fault."""
        left = self.steps_left(memory["left"], vehicles, key, step)
        wanted = torch.full_like(moved.acceleration, -self.faults.deceleration)
        # A driver who brakes harder anyway goes on doing so.
        brakes = (left > 0) & (moved.acceleration > wanted)
        braking = driven_at(vehicles, moved, wanted, self.dt)
        moved = braking.where(brakes, moved)
        return moved, {"left": (left - 1).clamp_min(0)}


class LateReaction(TimedFault[ReactionFaults]):
    """During a lapse a driver accelerates and brakes as it should have done ``delay_s`` before.

    What is delayed is the acceleration that the model below decides on,
    ``a(t) = f(state(t - delay))``: the reaction time of car-following models (Treiber, Kesting and
    Helbing 2006). A delayed perception would be the same for a model of the present state only;
    delaying the output fits every model. Steering is not delayed.

    Memory: ``past`` [N, M, D], the accelerations decided in the last ``delay_s``, m/s2, oldest
    first (at the start the present one), and ``left``, the remaining steps of the lapse.

    Attributes:
        delay_steps: D, the physics steps of ``delay_s``.
    """

    kind = ReactionFaults
    purpose = Purpose.LATE_REACTION

    def __init__(
        self,
        road: Road | None = None,
        stream: int = Stream.TRAIN,
        faults: ReactionFaults | None = None,
    ) -> None:
        super().__init__(road, stream, faults)
        # At least 1, since delay_s is a physics step or longer.
        self.delay_steps = round(self.faults.delay_s / self.dt)
        self.memory_fields = {
            "past": ((self.delay_steps,), None),
            "left": ((), torch.int64),
        }

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> Memory:
        """No lapse, a constant past acceleration."""
        # As if the driver had always accelerated as it does now.
        past = vehicles.acceleration[..., None].repeat(1, 1, self.delay_steps)
        return {"past": past, "left": torch.zeros_like(vehicles.target_lane)}

    def rewrite(
        self,
        vehicles: Vehicles,
        moved: Vehicles,
        memory: Memory,
        key: Tensor,
        step: Tensor,
    ) -> Moved:
        """Drive at the acceleration of ``delay_s`` ago during a lapse."""
        left = self.steps_left(memory["left"], vehicles, key, step)
        past = memory["past"]
        # Entry 0 is the oldest: decided delay_s ago.
        late = driven_at(vehicles, moved, past[..., 0], self.dt)

        new_memory = {
            # The model's decision is stored during a lapse, too, so the queue never has a hole.
            "past": torch.cat((past[..., 1:], moved.acceleration[..., None]), dim=-1),
            "left": (left - 1).clamp_min(0),
        }
        return late.where(left > 0, moved), new_memory


class HesitantLaneChange(Fault[HesitationFaults]):
    """Some changes take longer: lateral motion is multiplied by ``pace`` until the change is
    complete.

    Memory: whether the current change is ``hesitant``.
    """

    memory_fields = {"hesitant": ((), torch.bool)}  # noqa: RUF012
    kind = HesitationFaults
    purpose = Purpose.HESITANT_CHANGE

    def rewrite(
        self,
        vehicles: Vehicles,
        moved: Vehicles,
        memory: Memory,
        key: Tensor,
        step: Tensor,
    ) -> Moved:
        """Reduce the lateral motion of hesitant changes."""
        begins = starting(vehicles, moved)
        (u,) = uniforms(vehicles, key, step, self.purpose)
        # Decided once, when the change begins.
        hesitant = torch.where(begins, u < self.faults.share, memory["hesitant"])

        # From the position at t: only the step's lateral part shrinks.
        slowed = vehicles.y + self.faults.pace * (moved.y - vehicles.y)
        moved = moved.with_(y=torch.where(hesitant, slowed, moved.y))

        # The flag ends with the change; the next change draws anew.
        done = lane_change_done(moved, self.road)
        return moved, {"hesitant": hesitant & ~done}


class AbortedLaneChange(Fault[AbortFaults]):
    """Some changes are aborted: the driver turns back to its old lane.

    At the default of half way the body is still in the old lane, where the others have seen it all
    the time, so its place there is free.

    Memory: ``origin``, the lane to turn back to (-1: none).
    """

    memory_fields = {"origin": ((), torch.int64)}  # noqa: RUF012
    kind = AbortFaults
    purpose = Purpose.ABORTED_CHANGE

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> Memory:
        """No lane to turn back to."""
        return {"origin": torch.full_like(vehicles.target_lane, _NO_LANE)}

    def rewrite(
        self,
        vehicles: Vehicles,
        moved: Vehicles,
        memory: Memory,
        key: Tensor,
        step: Tensor,
    ) -> Moved:
        """Set the old lane as the target where the change has come far enough."""
        begins = starting(vehicles, moved)
        (u,) = uniforms(vehicles, key, step, self.purpose)
        # Where a change will be aborted, the lane to return to.
        aborts = u < self.faults.share
        chosen = torch.where(aborts, vehicles.target_lane, _NO_LANE)
        origin = torch.where(begins, chosen, memory["origin"])

        # Where nothing will be aborted, origin is -1 and start is not used.
        start = self.road.centre_of(origin, moved.y.dtype)
        end = self.road.centre_of(moved.target_lane, moved.y.dtype)
        # The share ``at`` of the way between the two centres is done.
        way_done = (moved.y - start).abs()
        far_enough = way_done >= self.faults.at * (end - start).abs()

        turns = (origin != _NO_LANE) & far_enough
        moved = moved.with_(target_lane=torch.where(turns, origin, moved.target_lane))
        return moved, {"origin": torch.where(turns, _NO_LANE, origin)}


def with_faults(base: TrafficModule, faults: DriverFaults | None = None) -> TrafficSequential:
    """``base`` with all four faults laid over it.

    Phantom braking comes after the late reactions, since it is no reaction and must not be delayed.

    Args:
        base: any traffic model or chain.
        faults: how often, and how bad; None: the defaults.

    Raises:
        UserError: ``base`` plays recordings.
    """
    faults = faults or DriverFaults()
    road = (base.road, base.stream)
    # Memories are stored under these names.
    parts: dict[str, TrafficModule] = {
        "base": base,
        "late_reaction": LateReaction(*road, faults.late_reaction),
        "phantom_braking": PhantomBraking(*road, faults.phantom_braking),
        "hesitant_change": HesitantLaneChange(*road, faults.hesitant_change),
        "aborted_change": AbortedLaneChange(*road, faults.aborted_change),
    }
    # The kernel knows faults of IDM and MOBIL's drivers only; other traffic runs in tensor code.
    drivers = base.native_drivers() if type(base) is IdmMobilTraffic else None
    if drivers is None:
        return TrafficSequential(parts)
    return TrafficSequential(parts, faulty_drivers(drivers, faults))
