"""Rule-driven traffic: IDM with or without MOBIL, steered like the ego; drivers alike or random."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ganlane.keys import EGO_INDEX
from ganlane.native.drivers import RuleDrivers
from ganlane.settings.driving import IdmParameters, MobilParameters, RandomDrivers
from ganlane.sim.dynamics import STEERING, SteeringParameters, drive
from ganlane.sim.idm import TABLE_V, AnyIdm, DriverIdm, following_acceleration, needed_deceleration
from ganlane.sim.mobil import TABLE_IV, mobil_changes, yielding
from ganlane.sim.neighbours import Scene, in_lane, perceive
from ganlane.sim.random import Purpose, Stream, absorb, in_range
from ganlane.sim.state import Road, Vehicles, reads_are_cheap
from ganlane.traffic.base import Entered, Memory, Moved, TrafficModule, uniforms

#: MOBIL decides once a second of simulated time, whatever the ego's decision period.
MOBIL_PERIOD_STEPS = 10
#: Minimum distance of a swaying body from its lane's markings, m.
_LANE_MARGIN_M = 0.1
#: A random driver's strongest braking is at least this many times what the initial scene requires
#: of it.
_START_MARGIN = 1.5
#: Random numbers of a random driver's parameters, and of the factor on its desired speed.
_DRAWS = range(Purpose.DRIVER, Purpose.DRIVER + 11)
_DESIRED_SPEED = Purpose.DRIVER + 11
#: Key of the random drivers' parameters in the memory, which stored training runs hold.
_PARAMETERS = "traits"


class IdmTraffic(TrafficModule):
    """``traffic=idm``: all keep their lanes (the paper's Traffic_IDM, 'without complex decisions').

    Memory: ``steering``, the steering angle of each vehicle, rad.

    Args:
        road, stream: as for every traffic module.
        idm: of all drivers.
        steering: the controller that keeps them in their lanes.
    """

    heeds_lane_ends = True
    memory_fields = {"steering": ((), None)}  # noqa: RUF012
    #: How drivers change lanes, and the ranges that they are drawn from, if they do and are.
    mobil: MobilParameters | None = None
    drivers: RandomDrivers | None = None

    def __init__(
        self,
        road: Road | None = None,
        stream: int = Stream.TRAIN,
        idm: IdmParameters = TABLE_V,
        steering: SteeringParameters = STEERING,
    ) -> None:
        super().__init__(road, stream)
        self.idm = idm
        self.steering = steering

    def native_drivers(self) -> RuleDrivers | None:
        """The kernel's drivers; None for a subclass, which may drive otherwise."""
        # Not isinstance: a subclass may override any part of a step.
        if type(self) not in (IdmTraffic, IdmMobilTraffic, IdmRandomTraffic):
            return None
        return RuleDrivers(
            self.idm,
            self.steering,
            self.mobil,
            random=self.drivers,
            stream=self.stream,
        )

    def move(self, vehicles: Vehicles, memory: Memory, key: Tensor, step: Tensor) -> Moved:
        """Decide, accelerate, steer, advance."""
        scene = perceive(vehicles, self.road)
        target = self.targets(scene, memory, step)
        return self.drive(scene, target, memory, step)

    def targets(self, scene: Scene, memory: Memory, step: Tensor) -> Tensor:
        """The lane that each driver keeps or changes to, [N, M] int64."""
        return scene.vehicles.target_lane

    def drive(self, scene: Scene, target: Tensor, memory: Memory, step: Tensor) -> Moved:
        """The vehicles at t + 0.1 s, steered to the lanes ``target`` [N, M] int64."""
        acceleration = self.following(scene, self.idm)
        centre = self.road.centre_of(target, scene.vehicles.y.dtype)
        return self.advanced(scene, acceleration, target, centre, memory)

    def following(self, scene: Scene, idm: AnyIdm) -> Tensor:
        """Accelerations behind the vehicles ahead, m/s2, [N, M]."""
        return following_acceleration(scene, idm)

    def advanced(
        self,
        scene: Scene,
        acceleration: Tensor,
        target: Tensor,
        line: Tensor,
        memory: Memory,
    ) -> Moved:
        """The vehicles at t + 0.1 s.

        Args:
            scene: at t.
            acceleration: that is driven, m/s2, [N, M].
            target: lanes that others may see the change to, [N, M] int64.
            line: lateral positions that the drivers steer to, m, [N, M].
            memory: with the steering angles at t.
        """
        moved, steering = drive(
            scene.vehicles,
            acceleration,
            memory["steering"],
            line,
            self.dt,
            self.steering,
        )
        return moved.with_(target_lane=target), {"steering": steering}


class IdmMobilTraffic(IdmTraffic):
    """``traffic=idm_mobil``: IDM with MOBIL's lane changes once a second (Tables IV and V).

    Args:
        road, stream, idm, steering: as of the base.
        mobil: of all drivers; also how they leave a lane that ends, and make room.
    """

    mobil: MobilParameters

    def __init__(
        self,
        road: Road | None = None,
        stream: int = Stream.TRAIN,
        idm: IdmParameters = TABLE_V,
        steering: SteeringParameters = STEERING,
        mobil: MobilParameters = TABLE_IV,
    ) -> None:
        super().__init__(road, stream, idm, steering)
        self.mobil = mobil

    def targets(self, scene: Scene, memory: Memory, step: Tensor) -> Tensor:
        """As IDM; drivers of the rows at a full second decide."""
        lane = scene.vehicles.target_lane
        due = step % MOBIL_PERIOD_STEPS == 0
        # Reading a flag is cheap on a CPU and saves nine evaluations of MOBIL in ten: without it a
        # decision of idm_mobil and idm_random takes half as long again (64 x 9 vehicles, one core).
        # On a GPU it would stall the queue.
        if reads_are_cheap(due) and not bool(due.any()):
            return lane
        changes = self.changes(scene, memory)
        return lane + torch.where(due[:, None], changes, 0)

    def following(self, scene: Scene, idm: AnyIdm) -> Tensor:
        """As IDM; where lanes end, drivers make room for those who have to leave theirs."""
        acceleration = super().following(scene, idm)
        if not self.road.stretches:
            return acceleration
        makes_room = yielding(scene, idm, self.mobil)
        return torch.minimum(acceleration, makes_room)

    def changes(self, scene: Scene, memory: Memory) -> Tensor:
        """The side that each driver changes to, -1, 0 or 1, [N, M]."""
        return mobil_changes(scene, self.idm, self.mobil)


class DriverParams(NamedTuple):
    """Per-driver parameters, tensors [N, M]; names and units as in :class:`RandomDrivers`.

    Attributes:
        headway: s.
        max_acceleration, comfortable_deceleration, strongest_braking: m/s2, all above 0.
        politeness: factor on MOBIL's weights of the followers.
        delay: reaction time in physics steps, a whole number.
        sway: largest distance from the centre of the lane that a driver aims at, m.
        frequency_one, frequency_two: angular frequencies of the two waves that make up a driver's
            sway, rad/s.
        phase_one, phase_two: of these waves, rad.
    """

    headway: Tensor
    max_acceleration: Tensor
    comfortable_deceleration: Tensor
    strongest_braking: Tensor
    politeness: Tensor
    delay: Tensor
    sway: Tensor
    frequency_one: Tensor
    frequency_two: Tensor
    phase_one: Tensor
    phase_two: Tensor

    @classmethod
    def of(cls, memory: Memory) -> DriverParams:
        """From the memory of :class:`IdmRandomTraffic`."""
        return cls(*memory[_PARAMETERS].unbind(-1))

    def idm(self, min_gap_m: float, braking: Tensor) -> DriverIdm:
        """IDM with each driver's parameters.

        No driver brakes harder than ``braking`` (m/s2, [N, M]).
        """
        # IDM's bound is an acceleration, so braking changes its sign.
        return DriverIdm(
            min_gap_m,
            self.headway,
            self.comfortable_deceleration,
            -braking,
            self.max_acceleration,
        )

    def sway_m(self, time_s: Tensor) -> Tensor:
        """How far each driver aims to the left of its lane's centre at ``time_s`` [N, 1], m."""
        wave_one = torch.sin(self.frequency_one * time_s + self.phase_one)
        wave_two = torch.sin(self.frequency_two * time_s + self.phase_two)
        # Two sines add up to at most 2, so the sway stays within its bound.
        return 0.5 * self.sway * (wave_one + wave_two)


def start_braking(
    vehicles: Vehicles, road: Road, reaction_s: Tensor, min_gap_m: float = TABLE_V.min_gap_m
) -> Tensor:
    """Deceleration (m/s2, [N, M]) with which each driver stays behind all ahead in its lane.

    These keep their speeds; each vehicle in between takes the longest length and ``min_gap_m``.

    Args:
        vehicles: the initial scene, [N, M].
        road: under it.
        reaction_s: after which braking begins, [N, M].
        min_gap_m: between two standing vehicles.
    """
    scene = perceive(vehicles, road)
    pairs = scene.pairs

    # [N, i, j]: j is ahead of i in a lane that i attends to. Everybody ahead counts, not only the
    # leader, who may not brake in time itself.
    shares = in_lane(scene, scene.attention.low) | in_lane(scene, scene.attention.high)
    ahead = shares & (pairs.order > 0)

    # Rank of each vehicle ahead (an argsort of an argsort): so many bodies and gaps have to fit
    # between.
    distance = torch.where(ahead, pairs.distance, torch.inf)
    between = distance.argsort(-1).argsort(-1).to(vehicles.x.dtype)
    longest = vehicles.length.amax(-1)[:, None, None]
    space = longest + min_gap_m

    # What is left of the gap, m, once the driver reacts.
    speed = vehicles.speed[:, :, None]
    leader_speed = vehicles.speed[:, None, :]
    closing = (speed - leader_speed).clamp_min(0.0)
    gap = pairs.ahead - between * space - closing * reaction_s[..., None]

    # Where nothing is left, a gap of 1 m stands in, which keeps the deceleration finite.
    needed = needed_deceleration(speed, leader_speed, gap.clamp_min(1.0))
    return torch.where(ahead, needed, 0.0).amax(-1)


class IdmRandomTraffic(IdmMobilTraffic):
    """``traffic=idm_random``: IDM and MOBIL, each driver with its own parameters for the whole
    episode.

    In MOBIL a driver predicts the others with its own parameters, since it does not know theirs,
    and without a limit of braking.

    Memory: ``steering``, ``traits`` [N, M, 11] (:class:`DriverParams`) and, with reaction times,
    ``past`` [N, M, D], the accelerations decided in the last D steps, m/s2, oldest first.

    Args:
        road, stream, steering: as for every rule-driven traffic.
        idm: minimum gap of all drivers; the hardest braking in MOBIL's predictions.
        mobil: threshold, safe deceleration, and the weights that the politeness multiplies.
        drivers: the ranges.
    """

    drivers: RandomDrivers

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
        # The queue is as long as the slowest driver's reaction.
        slowest_s = self.drivers.reaction_s[1]
        self.delay_steps = round(slowest_s / self.dt)
        fields = {
            "steering": ((), None),
            _PARAMETERS: ((len(DriverParams._fields),), None),
        }
        if self.delay_steps:
            fields["past"] = ((self.delay_steps,), None)
        self.memory_fields = fields

    def driver_params(self, vehicles: Vehicles, key: Tensor) -> DriverParams:
        """The drivers at the start of the episodes with ``key`` [N]."""
        drivers = self.drivers
        # Each number has a fixed use: another order would change every episode.
        # Step -1 is no step of an episode, so nothing else draws these numbers.
        (
            u_headway,
            u_acceleration,
            u_deceleration,
            u_braking,
            u_politeness,
            u_reaction,
            u_sway,
            u_period_one,
            u_period_two,
            u_phase_one,
            u_phase_two,
        ) = uniforms(vehicles, key, -1, *_DRAWS)

        # The scene may ask more of a driver than its range has: it then brakes as hard as that.
        reaction_s = in_range(u_reaction, drivers.reaction_s)
        required = start_braking(vehicles, self.road, reaction_s, self.idm.min_gap_m)
        braking = in_range(u_braking, drivers.strongest_braking)

        # Even at its largest sway a body stays within its lane.
        room = 0.5 * (self.road.lane_width_m - vehicles.width) - _LANE_MARGIN_M
        sway = in_range(u_sway, drivers.sway_m)

        return DriverParams(
            headway=in_range(u_headway, drivers.headway_s),
            max_acceleration=in_range(u_acceleration, drivers.max_acceleration),
            comfortable_deceleration=in_range(u_deceleration, drivers.comfortable_deceleration),
            strongest_braking=torch.maximum(braking, _START_MARGIN * required),
            politeness=in_range(u_politeness, drivers.politeness),
            delay=torch.round(reaction_s / self.dt),
            sway=torch.minimum(sway, room.clamp_min(0.0)),
            frequency_one=2.0 * math.pi / in_range(u_period_one, drivers.sway_period_s),
            frequency_two=2.0 * math.pi / in_range(u_period_two, drivers.sway_period_s),
            phase_one=2.0 * math.pi * u_phase_one,
            phase_two=2.0 * math.pi * u_phase_two,
        )

    def enter(self, vehicles: Vehicles, key: Tensor, episode: Tensor) -> Entered:
        """Gives every driver but the ego its own desired speed."""
        (u,) = uniforms(vehicles, absorb(key, 0), -1, _DESIRED_SPEED)
        factor = in_range(u, self.drivers.desired_speed)
        desired_speed = factor * vehicles.desired_speed
        # The ego's is the environment's.
        desired_speed[:, EGO_INDEX] = vehicles.desired_speed[:, EGO_INDEX]
        vehicles = vehicles.with_(desired_speed=desired_speed)
        return super().enter(vehicles, key, episode)

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> Memory:
        """Steering angle 0, a constant past acceleration, and the drivers' parameters."""
        memory = super().fresh_memory(vehicles, key)
        memory[_PARAMETERS] = torch.stack(self.driver_params(vehicles, key), dim=-1)
        if self.delay_steps:
            # As if the driver had always accelerated as it does now.
            memory["past"] = vehicles.acceleration[..., None].repeat(1, 1, self.delay_steps)
        return memory

    def changes(self, scene: Scene, memory: Memory) -> Tensor:
        """As :class:`IdmMobilTraffic`, with each driver's parameters."""
        drivers = DriverParams.of(memory)
        # Predictions are not limited by what this driver would brake itself.
        braking = torch.full_like(drivers.headway, -self.idm.min_acceleration)
        idm = drivers.idm(self.idm.min_gap_m, braking)
        # [N, M, 1]: one weight for both sides that a driver looks at.
        politeness = drivers.politeness[..., None]
        return mobil_changes(scene, idm, self.mobil, politeness)

    def drive(self, scene: Scene, target: Tensor, memory: Memory, step: Tensor) -> Moved:
        """The vehicles at t + 0.1 s, with each driver's delay and sway."""
        drivers = DriverParams.of(memory)
        idm = drivers.idm(self.idm.min_gap_m, drivers.strongest_braking)
        acceleration = self.following(scene, idm)
        new_memory = {_PARAMETERS: memory[_PARAMETERS]}

        if self.delay_steps:
            # What was decided ``delay`` steps ago is driven now. Of the D + 1 decisions in
            # ``recent`` the last is the present one, which a delay of 0 takes.
            recent = torch.cat((memory["past"], acceleration[..., None]), dim=-1)
            index = self.delay_steps - drivers.delay.long()
            acceleration = recent.gather(-1, index[..., None])[..., 0]
            new_memory["past"] = recent[..., 1:].contiguous()

        # Drivers aim beside the centres of their lanes, m.
        time_s = step.to(drivers.sway.dtype) * self.dt
        centre = self.road.centre_of(target, scene.vehicles.y.dtype)
        line = centre + drivers.sway_m(time_s[:, None])

        moved, steering = self.advanced(scene, acceleration, target, line, memory)
        return moved, {**steering, **new_memory}
