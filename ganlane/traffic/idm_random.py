"""Rule-driven traffic in which no two drivers are alike: IDM and MOBIL with parameters drawn per driver."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ganlane.keys import EGO_INDEX
from ganlane.parameters.driving import IdmParameters, MobilParameters
from ganlane.parameters.traffic import RandomDrivers, Range
from ganlane.sim.bicycle import advance
from ganlane.sim.braking import needed_deceleration
from ganlane.sim.following import following_acceleration
from ganlane.sim.idm import TABLE_V, DriverIdm
from ganlane.sim.mobil import TABLE_IV, DriverMobil, mobil_changes
from ganlane.sim.neighbours import Scene, in_lane, perceive
from ganlane.sim.random import Purpose, Stream, absorb, uniform
from ganlane.sim.road import Road
from ganlane.sim.steering import STEERING, SteeringParameters, steer
from ganlane.sim.vehicles import Vehicles
from ganlane.traffic.base import MemoryFields
from ganlane.traffic.idm_mobil import IdmMobilTraffic

#: A body that sways stays at least so far inside its lane's markings, m.
_LANE_MARGIN_M = 0.1
#: What a driver can brake with is at least so many times what the first scene asks of it.
_START_MARGIN = 1.5


class Traits(NamedTuple):
    """A driver's parameters, tensors [N, M]; names and units as in :class:`RandomDrivers`.

    ``delay`` is the reaction time in physics steps; the last four are angular frequencies (rad/s) and phases (rad) of
    the two waves that a driver's sway is made of.
    """

    headway: Tensor
    max_acceleration: Tensor
    comfortable_deceleration: Tensor
    strongest_braking: Tensor
    politeness: Tensor
    delay: Tensor
    sway: Tensor
    pace_one: Tensor
    pace_two: Tensor
    phase_one: Tensor
    phase_two: Tensor


def start_braking(vehicles: Vehicles, road: Road, reaction_s: Tensor, min_gap_m: float = TABLE_V.min_gap_m) -> Tensor:
    """Deceleration (m/s2, [N, M]) with which each driver stays behind all those ahead of it in its lane.

    Each of them keeps its speed, and who is in between takes its length and ``min_gap_m``. Braking begins after
    ``reaction_s`` [N, M].
    """
    scene = perceive(vehicles, road)
    shares = in_lane(scene, scene.attention.low) | in_lane(scene, scene.attention.high)
    ahead = shares & (scene.order > 0)
    distance = torch.where(ahead, scene.distance, torch.inf)
    between = distance.argsort(-1).argsort(-1).to(vehicles.x.dtype)
    space = vehicles.length.amax(-1)[:, None, None] + min_gap_m
    speed, theirs = vehicles.speed[:, :, None], vehicles.speed[:, None, :]
    gap = scene.ahead - between * space - (speed - theirs).clamp_min(0.0) * reaction_s[..., None]
    needed = needed_deceleration(speed, theirs, gap.clamp_min(1.0))
    return torch.where(ahead, needed, 0.0).amax(-1)


class IdmRandomTraffic(IdmMobilTraffic):
    """``traffic=idm_random``: IDM and MOBIL, each driver with parameters of its own for the whole episode.

    MOBIL judges what others would have to do by the driver's own parameters, since it knows no others', and without
    the limit of the brakes. Memory, beside the steering angle: ``traits`` [N, M, 11] (:class:`Traits`) and, if
    anybody reacts late, ``past`` [N, M, D], the accelerations decided on in the last D steps, m/s2, oldest first.

    Args:
        road, stream, steering: as for every rule-driven traffic.
        idm: minimum gap of everybody; the hardest braking that MOBIL reckons with.
        mobil: threshold, safe deceleration, and the weights that the politeness multiplies.
        drivers: the ranges.
    """

    def __init__(
        self,
        road: Road | None = None,
        stream: int = Stream.TRAIN,
        idm: IdmParameters = TABLE_V,
        steering: SteeringParameters = STEERING,
        mobil: MobilParameters = TABLE_IV,
        drivers: RandomDrivers | None = None,
    ) -> None:
        super().__init__(road, stream, idm, steering, mobil)
        self.drivers = drivers or RandomDrivers()
        self.delay_steps = round(self.drivers.reaction_s[1] / self.dt)

    @property
    def memory_fields(self) -> MemoryFields:  # type: ignore[override]
        """Trailing shapes of the memory."""
        past: MemoryFields = {"past": ((self.delay_steps,), None)} if self.delay_steps else {}
        return {"steering": ((), None), "traits": ((len(Traits._fields),), None), **past}

    def _drawn(self, vehicles: Vehicles, key: Tensor) -> list[Tensor]:
        """Uniform numbers [N, M], one for each of 13 purposes."""
        purposes = [Purpose.DRIVER + index for index in range(13)]
        return list(uniform(key, -1, vehicles.x.shape[1], purposes, vehicles.x.dtype).unbind(-1))

    def traits(self, vehicles: Vehicles, key: Tensor) -> Traits:
        """The drivers of the episodes with ``key`` [N], at their start."""
        d, u = self.drivers, self._drawn(vehicles, key)
        ranges = (d.headway_s, d.max_acceleration, d.comfortable_deceleration, d.strongest_braking, d.politeness)
        headway, most, comfortable, braking, politeness = (between(u[at], each) for at, each in enumerate(ranges))
        reaction_s = between(u[5], d.reaction_s)
        asked = _START_MARGIN * start_braking(vehicles, self.road, reaction_s, self.idm.min_gap_m)
        room = 0.5 * (self.road.lane_width_m - vehicles.width) - _LANE_MARGIN_M
        paces = (2.0 * math.pi / between(u[at], d.sway_period_s) for at in (7, 8))
        phases = (2.0 * math.pi * u[at] for at in (9, 10))
        return Traits(
            headway,
            most,
            comfortable,
            torch.maximum(braking, asked),
            politeness,
            torch.round(reaction_s / self.dt),
            torch.minimum(between(u[6], d.sway_m), room.clamp_min(0.0)),
            *paces,
            *phases,
        )

    def enter(self, vehicles: Vehicles, key: Tensor, episode: Tensor) -> tuple[Vehicles, TensorDictBase]:
        """The others' desired speeds are their own."""
        factor = between(self._drawn(vehicles, absorb(key, 0))[11], self.drivers.desired_speed)
        others = torch.arange(vehicles.x.shape[1], device=key.device) != EGO_INDEX
        desired = torch.where(others, factor * vehicles.desired_speed, vehicles.desired_speed)
        return super().enter(vehicles.with_(desired_speed=desired), key, episode)

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> dict[str, Tensor]:
        """Wheels straight, a steady acceleration, and everybody's parameters."""
        memory = super().fresh_memory(vehicles, key)
        memory["traits"] = torch.stack(self.traits(vehicles, key), dim=-1)
        if self.delay_steps:
            memory["past"] = vehicles.acceleration[..., None].repeat(1, 1, self.delay_steps)
        return memory

    def move(self, vehicles: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor) -> tuple[Vehicles, dict]:
        """As :class:`IdmMobilTraffic`; the clock goes along with the memory, for the sway."""
        return super().move(vehicles, {**memory, "step": step}, key, step)

    def decide(self, vehicles: Vehicles, memory: dict[str, Tensor], due: Tensor) -> tuple[Vehicles, dict]:
        """A step in which the drivers of the rows ``due`` [N] decide."""
        scene, own = perceive(vehicles, self.road), Traits(*memory["traits"].unbind(-1))
        judged = self._idm(own, torch.full_like(own.headway, -self.idm.min_acceleration))
        m, politeness = self.mobil, own.politeness[..., None]
        mobil = DriverMobil(
            m.threshold,
            politeness * m.politeness_rear,
            politeness * m.politeness_side,
            m.safe_deceleration,
            m.exclusive_m,
        )
        change = torch.where(due[:, None], mobil_changes(scene, self.road, judged, mobil), 0)
        return self.drive(scene, vehicles.target_lane + change, memory)

    def _idm(self, own: Traits, braking: Tensor) -> DriverIdm:
        """IDM with each driver's parameters; nobody brakes harder than ``braking`` [N, M]."""
        return DriverIdm(
            self.idm.min_gap_m, own.headway, own.comfortable_deceleration, -braking, own.max_acceleration
        )

    def drive(self, scene: Scene, target: Tensor, memory: dict[str, Tensor]) -> tuple[Vehicles, dict]:
        """Everybody at t + 0.1 s, each as late and as far beside the lane's centre as it drives."""
        v, own = scene.vehicles, Traits(*memory["traits"].unbind(-1))
        wanted = following_acceleration(scene, self._idm(own, own.strongest_braking))
        acceleration, past = self._late(wanted, own, memory)
        line = self.road.centre_of(target, v.y.dtype) + self.sway(own, memory["step"])
        steering = steer(memory["steering"], v.y, v.heading, v.speed, line, self.dt, self.steering)
        pose = advance(v.x, v.y, v.heading, v.speed, acceleration, steering, self.dt)
        kept = {"steering": steering, "traits": memory["traits"], **past}
        return v.with_(target_lane=target, **pose._asdict()), kept

    def _late(self, wanted: Tensor, own: Traits, memory: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """What was decided on a reaction time ago, and what to remember for later."""
        if not self.delay_steps:
            return wanted, {}
        decided = torch.cat((memory["past"], wanted[..., None]), dim=-1)
        at = self.delay_steps - own.delay.long()
        return decided.gather(-1, at[..., None])[..., 0], {"past": decided[..., 1:].contiguous()}

    def sway(self, own: Traits, step: Tensor) -> Tensor:
        """How far beside its lane's centre each driver aims at ``step`` [N], m, to the left, [N, M]."""
        t = (step.to(own.sway.dtype) * self.dt)[:, None]
        waves = torch.sin(own.pace_one * t + own.phase_one) + torch.sin(own.pace_two * t + own.phase_two)
        return 0.5 * own.sway * waves


def between(u: Tensor, bounds: Range) -> Tensor:
    """From uniform numbers in [0, 1) to ``bounds``."""
    return bounds[0] + u * (bounds[1] - bounds[0])
