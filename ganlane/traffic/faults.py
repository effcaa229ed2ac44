"""Faults of drivers along the road, as overlays on any traffic model: phantom braking and late reactions.

Those across the road stand in :mod:`ganlane.traffic.lane_change_faults`. Each fault is a module of its own, comes
at random to one driver at a time (never to the ego), and leaves the others bitwise as they were moved.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ganlane.keys import EGO_INDEX
from ganlane.parameters.traffic import BrakingFaults, ReactionFaults
from ganlane.sim.random import Purpose, Stream, uniform
from ganlane.sim.road import Road
from ganlane.sim.vehicles import Vehicles
from ganlane.traffic.base import MemoryFields
from ganlane.traffic.sequential import Overlay

#: A step shorter than this has no direction of its own, m: the vehicle then moves along its heading.
_SHORTEST_M = 1e-3


def drivers(vehicles: Vehicles) -> Tensor:
    """Whom a fault may come to: everybody who is there but the ego, bool [N, M]."""
    index = torch.arange(vehicles.x.shape[1], device=vehicles.x.device)
    return vehicles.valid & (index != EGO_INDEX)


def chance_per_step(per_hour: float, dt: float) -> float:
    """Probability per step of ``dt`` s of what comes ``per_hour`` times an hour, at a constant hazard."""
    return -math.expm1(-per_hour * dt / 3600.0)


def drawn(key: Tensor, step: Tensor, vehicles: Vehicles, purpose: Purpose) -> Tensor:
    """A uniform number per vehicle, [N, M]."""
    return uniform(key, step, vehicles.x.shape[1], [purpose], vehicles.x.dtype)[..., 0]


def driven_at(vehicles: Vehicles, moved: Vehicles, acceleration: Tensor, dt: float) -> Vehicles:
    """``moved`` with another ``acceleration`` (m/s2, [N, M]): the same path, driven more slowly or faster.

    Position and heading go along the path from ``vehicles`` to ``moved`` in proportion to the distance driven.
    """
    speed = (vehicles.speed + acceleration * dt).clamp_min(0.0)
    usual = 0.5 * (vehicles.speed + moved.speed) * dt
    distance = 0.5 * (vehicles.speed + speed) * dt
    share = distance / usual.clamp_min(_SHORTEST_M)
    path = usual > _SHORTEST_M
    x = torch.where(path, share * (moved.x - vehicles.x), distance * torch.cos(vehicles.heading))
    y = torch.where(path, share * (moved.y - vehicles.y), distance * torch.sin(vehicles.heading))
    turn = torch.where(path, share * (moved.heading - vehicles.heading), 0.0)
    return moved.with_(
        x=vehicles.x + x,
        y=vehicles.y + y,
        heading=vehicles.heading + turn,
        speed=speed,
        acceleration=(speed - vehicles.speed) / dt,
    )


def steps_left(
    left: Tensor, u: Tensor, vehicles: Vehicles, faults: BrakingFaults | ReactionFaults, dt: float
) -> Tensor:
    """Steps that a fault still lasts, [N, M] int64: ``left``, or all of them where the fault begins now.

    It begins where there is none, with the probability of a step, by the uniform numbers ``u`` [N, M].
    """
    begins = (left == 0) & drivers(vehicles) & (u < chance_per_step(faults.per_hour, dt))
    return torch.where(begins, round(faults.lasts_s / dt), left)


class PhantomBraking(Overlay):
    """Now and then a driver brakes for nothing. Memory: the steps of braking that are left."""

    memory_fields = {"left": ((), torch.int64)}  # noqa: RUF012

    def __init__(
        self, road: Road | None = None, stream: int = Stream.TRAIN, faults: BrakingFaults | None = None
    ) -> None:
        super().__init__(road, stream)
        self.faults = faults or BrakingFaults()

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> dict[str, Tensor]:
        """Nobody brakes."""
        return {"left": torch.zeros_like(vehicles.target_lane)}

    def rewrite(
        self, vehicles: Vehicles, moved: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor
    ) -> tuple[Vehicles, dict[str, Tensor]]:
        """Brake where a fault begins or goes on."""
        f = self.faults
        u = drawn(key, step, vehicles, Purpose.FAULT)
        left = steps_left(memory["left"], u, vehicles, f, self.dt)
        brakes = (left > 0) & (moved.acceleration > -f.deceleration)
        braking = driven_at(vehicles, moved, torch.full_like(moved.acceleration, -f.deceleration), self.dt)
        return braking.where(brakes, moved), {"left": (left - 1).clamp_min(0)}


class LateReaction(Overlay):
    """For a while a driver accelerates and brakes as he should have done ``delay_s`` before.

    What is delayed is the acceleration that the model below decides on, ``a(t) = f(state(t - delay))``: the
    reaction time of car-following models (Treiber, Kesting and Helbing 2006). A delayed perception would be the
    same for a model that looks at the present state alone; delaying the output needs no knowledge of the model, so
    it fits every one. Steering is not delayed.

    Memory: ``past`` [N, M, D], the accelerations decided on in the last ``delay_s``, m/s2, oldest first (one who
    enters has always accelerated as at present), and the steps that are ``left`` of the lapse.
    """

    def __init__(
        self, road: Road | None = None, stream: int = Stream.TRAIN, faults: ReactionFaults | None = None
    ) -> None:
        super().__init__(road, stream)
        self.faults = faults or ReactionFaults()
        self.delay_steps = round(self.faults.delay_s / self.dt)

    @property
    def memory_fields(self) -> MemoryFields:  # type: ignore[override]
        """Trailing shapes of the memory."""
        return {"past": ((self.delay_steps,), None), "left": ((), torch.int64)}

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> dict[str, Tensor]:
        """Attentive, at a steady acceleration."""
        past = vehicles.acceleration[..., None].repeat(1, 1, self.delay_steps)
        return {"past": past, "left": torch.zeros_like(vehicles.target_lane)}

    def rewrite(
        self, vehicles: Vehicles, moved: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor
    ) -> tuple[Vehicles, dict[str, Tensor]]:
        """Drive at the acceleration of ``delay_s`` ago where attention lapses."""
        u = drawn(key, step, vehicles, Purpose.LATE_REACTION)
        left = steps_left(memory["left"], u, vehicles, self.faults, self.dt)
        late = driven_at(vehicles, moved, memory["past"][..., 0], self.dt)
        past = torch.cat((memory["past"][..., 1:], moved.acceleration[..., None]), dim=-1)
        return late.where(left > 0, moved), {"past": past, "left": (left - 1).clamp_min(0)}
