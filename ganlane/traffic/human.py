"""``traffic=human``: one stochastic policy for all drivers, fitted to recorded ones.

Every 0.4 s a driver decides (:mod:`ganlane.generator.human`); in between it holds its acceleration
and goes over to its lateral speed evenly. The ego is a driver like any other to them.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ganlane.generator.human import (
    ACROSS,
    ALONG,
    REAR_BRAKING,
    STEPS,
    HumanPolicy,
    bounded,
    chosen,
    features_of,
    lane_choice,
    leaves_room,
    remembered,
    situation_of,
    velocity,
    with_choice,
    with_velocity,
)
from ganlane.generator.human import Memory as DriverMemory
from ganlane.generator.human_tuning import entering_memory
from ganlane.native.drivers import HumanDrivers
from ganlane.settings.driving import MobilParameters, Visibility
from ganlane.sim.idm import acceleration_before_wall
from ganlane.sim.lane_ends import WaysOut, room_before_wall, ways_out
from ganlane.sim.mobil import TABLE_IV, yielding
from ganlane.sim.neighbours import Scene
from ganlane.sim.neighbours import perceive as scene_of
from ganlane.sim.random import Purpose, normal
from ganlane.sim.state import Road, Vehicles, body_lanes, reads_are_cheap, spanned, with_target
from ganlane.traffic.base import Memory, Moved, TrafficModule, in_dtype, uniforms, where_rows

#: Ahead and behind of who leaves a lane that ends, m: who makes room leaves as much at least.
LEAST_ROOM_M = 1.0
#: By how much a body may reach into a lane, beyond what counts as touching it, without heeding its
#: end, m.
BESIDE_WALL_M = 0.4
#: Random numbers of a decision: moves along and across, a lane change, and one where a lane ends.
_DRAWS = (
    Purpose.ACCELERATION,
    Purpose.LANE_CHANGE_SPEED,
    Purpose.LANE_CHANGE_SIDE,
    Purpose.LANE_CHANGE_HAZARD,
)


class HumanTraffic(TrafficModule):
    """Drivers of a fitted policy.

    Memory: that of :class:`ganlane.generator.human.Memory`, and what was decided: ``acceleration``
    in m/s2, ``lateral_from`` and ``lateral_to`` in m/s, [N, M] each.

    Args:
        policy: the fitted policy (:func:`ganlane.generator.load_human`).
        drivers: the same for the native kernel: how they differ from the fitted ones, their stream.
        road: as for every traffic module.
        mobil: how drivers leave a lane that ends, and make room for those who have to.
    """

    visibility = Visibility.BODY
    heeds_lane_ends = True

    def __init__(
        self,
        policy: HumanPolicy,
        drivers: HumanDrivers,
        road: Road | None = None,
        mobil: MobilParameters = TABLE_IV,
    ) -> None:
        super().__init__(road, drivers.stream)
        self.policy = policy
        self.drivers = drivers
        self.mobil = mobil
        # The same as the kernel's, in the run's float type: there the names are paths of keys.
        memory = drivers.memory().items()
        self.memory_fields = {path[-1]: (shape, None) for path, (_, shape) in memory}

    def native_drivers(self) -> HumanDrivers:
        """Those that it was made with."""
        return self.drivers

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> Memory:
        """Drivers who have always driven as they do now; headways that nothing shows are drawn."""
        count = vehicles.x.shape[1]
        dtype = vehicles.x.dtype
        # Step -1: before the first step of the episode.
        drawn = normal(key, -1, count, [Purpose.TRAIT_HEADWAY], dtype)[..., 0]
        memory = entering_memory(vehicles, self.road, drawn)

        # Until the first decision, which is due at once, everybody goes straight on.
        _, lateral = velocity(vehicles)
        nothing = torch.zeros_like(vehicles.x)
        return {
            **memory._asdict(),
            "acceleration": nothing,
            "lateral_from": lateral,
            "lateral_to": lateral,
        }

    @torch.no_grad()
    def move(self, vehicles: Vehicles, memory: Memory, key: Tensor, step: Tensor) -> Moved:
        """Drive 0.1 s, after a decision where one is due."""
        # Steps since the last decision, [N].
        phase = step % STEPS
        vehicles, memory = self._where_due(vehicles, memory, key, step, phase == 0)

        # Evenly from the lateral speed at the decision to the one that was chosen.
        share = (phase[:, None] + 1).to(vehicles.x.dtype) / STEPS
        change = memory["lateral_to"] - memory["lateral_from"]
        across = memory["lateral_from"] + share * change

        # The acceleration holds until the driver stands. A body turns no further than its speed
        # allows, so the new lateral speed is read again.
        speed, lateral = velocity(vehicles)
        new_speed = (speed + memory["acceleration"] * self.dt).clamp_min(0.0)
        moved = with_velocity(vehicles, new_speed, across)
        _, new_lateral = velocity(moved)

        # At the means of the speeds before and after.
        moved = moved.with_(
            x=vehicles.x + 0.5 * (speed + new_speed) * self.dt,
            y=vehicles.y + 0.5 * (lateral + new_lateral) * self.dt,
            acceleration=(new_speed - speed) / self.dt,
        )
        return moved, memory

    def _where_due(
        self,
        vehicles: Vehicles,
        memory: Memory,
        key: Tensor,
        step: Tensor,
        due: Tensor,
    ) -> Moved:
        """Decisions in the rows where one is due: rows begin at steps of their own.

        On a CPU the other rows are left out of the policy; elsewhere all rows decide, since to
        count those that are due would wait for the device or break a compiled graph.

        Args:
            vehicles, memory, key, step: as of :meth:`move`.
            due: bool [N].

        Returns:
            Vehicles and memory, in the other rows as they were.
        """
        if not reads_are_cheap(vehicles.x):
            decided, new_memory = self.decide(vehicles, memory, key, step)
            new_memory = {
                name: where_rows(due, new_memory[name], value) for name, value in memory.items()
            }
            return decided.where(due, vehicles), new_memory

        rows = due.nonzero()[:, 0]
        if len(rows) == len(due):
            return self.decide(vehicles, memory, key, step)
        if not len(rows):
            return vehicles, memory

        # The rows that are due decide by themselves, and go back to their places.
        part = vehicles.part(rows)
        its_memory = {name: value[rows] for name, value in memory.items()}
        decided, new_memory = self.decide(part, its_memory, key[rows], step[rows])
        # Of the vehicles a decision changes the target lanes only.
        target = vehicles.target_lane.index_copy(0, rows, decided.target_lane)
        merged = {
            name: value.index_copy(0, rows, new_memory[name]) for name, value in memory.items()
        }
        return vehicles.with_(target_lane=target), merged

    def decide(self, vehicles: Vehicles, memory: Memory, key: Tensor, step: Tensor) -> Moved:
        """Target lanes, and the memory with what every driver does for 0.4 s.

        Perceive, choose a lane, draw a move, bound it: the policy knows roads whose lanes go on for
        ever, and where lanes end rules come on top of it.

        Args:
            vehicles, memory, key, step: as of :meth:`move`.

        Returns:
            The vehicles with their new target lanes, and the memory.
        """
        policy = in_dtype(self.policy, vehicles.x.dtype)
        variation = self.drivers.variation
        # Uniform numbers [N, M].
        u_along, u_across, u_lane, u_leaving = uniforms(vehicles, key, step, *_DRAWS)
        if self.road.stretches:
            # m/s2 [N, M], for a neighbour who has to leave its lane; from before the choices.
            scene = scene_of(vehicles, self.road)
            makes_room = yielding(scene, self.drivers.idm, self.mobil)

        # What every driver perceives, with what it remembers.
        vehicles = vehicles.with_(target_lane=self.road.clamp_lane(vehicles.target_lane))
        driver = DriverMemory(*(memory[name] for name in DriverMemory._fields))
        situation = situation_of(vehicles, driver, self.road)

        # A choice [N, M] between going on, left and right; by the sides as a polite driver takes
        # them to be, while ``sides`` are what they are.
        option = lane_choice(situation)
        sides = option.sides.clone()
        option.sides[..., REAR_BRAKING] *= variation.politeness
        if self.road.stretches:
            # Only to lanes that are there, beside the driver.
            ways = ways_out(vehicles, self.road, self.mobil.mandatory_m)
            option = option._replace(exists=torch.stack((ways.left, ways.right), -1))
        chances = policy.lane_chances(option, variation.lane_changes)
        choice = chosen(chances, u_lane)

        # Whose lane ends may have to leave it, whatever the policy says.
        if self.road.stretches:
            choice = _leaving(choice, option.keeping, ways, sides, u_leaving)
        situation = with_choice(situation, choice)
        vehicles = situation.vehicles

        # Its moves follow the driver's choice: changes in m/s2 along, in m/s across.
        along, across = policy(features_of(situation))
        change = ALONG.sample(along, u_along, variation.temperature)
        aside = ACROSS.sample(across, u_across, variation.temperature)
        acceleration, lateral = bounded(situation, change, aside)

        # The end of a lane, and who has to leave one, bound the acceleration further.
        if self.road.stretches:
            before_walls = self._before_walls(vehicles, scene)
            acceleration = torch.minimum(acceleration, before_walls)
            acceleration = torch.minimum(acceleration, makes_room)

        driver = remembered(situation, acceleration)
        new_memory = {
            **driver._asdict(),
            # Drivers who react late drive what they decided so many decisions ago.
            "acceleration": driver.accelerations[..., variation.delayed],
            "lateral_from": situation.view.aside,
            "lateral_to": lateral,
        }
        return vehicles, new_memory

    def _before_walls(self, vehicles: Vehicles, scene: Scene) -> Tensor:
        """IDM's acceleration before the walls of lanes, m/s2 [N, M]; inf where there is none.

        A driver heeds those of its target lane, and of the lanes that its front reaches into by
        half a metre: unlike drivers by rules these do not keep to the centres of their lanes, and
        they would brake for the end of another lane, or for one that lies behind them.

        Args:
            vehicles: with the target lanes that they have chosen.
            scene: theirs from before the choice.
        """
        # The front end as a straight, narrower body, as far aside as the heading puts it.
        aside = 0.5 * vehicles.length * torch.sin(vehicles.heading)
        front = vehicles.with_(
            y=vehicles.y + aside,
            heading=torch.zeros_like(aside),
            width=vehicles.width - 2.0 * BESIDE_WALL_M,
        )
        attended = with_target(body_lanes(front, self.road), vehicles)

        # Per driver and lane, [N, M, 1 to 3].
        lanes = spanned(attended)
        keeps = lanes == vehicles.target_lane[..., None]
        acceleration = acceleration_before_wall(scene, lanes, keeps, self.drivers.idm)

        # A wall that lies behind does not count; of several the one that asks most does.
        is_ahead = room_before_wall(vehicles, lanes, self.road) >= 0.0
        return torch.where(is_ahead, acceleration, torch.inf).amin(-1)


def _leaving(
    choice: Tensor,
    keeping: Tensor,
    ways: WaysOut,
    sides: Tensor,
    u: Tensor,
) -> Tensor:
    """The choices of drivers whose lane ends: out of it, the sooner the nearer its end is.

    Recordings show no such lanes, so this is no part of the policy. Like its own changes these
    leave others room.

    Args:
        choice: the policy's, [N, M]: 0 go on, 1 left, 2 right.
        keeping: whether the driver is in its target lane, [N, M].
        ways: how it can leave its lane, and how urgent that is.
        sides: [N, M, 2, SIDE_FEATURES], left and right.
        u: uniform numbers [N, M].
    """
    to_left = ways.side == 1
    side = torch.where(to_left[..., None], sides[..., 0, :], sides[..., 1, :])
    wants = keeping & (ways.side != 0) & (u < ways.urgency)
    leaves = wants & leaves_room(side, LEAST_ROOM_M)
    its_choice = torch.where(to_left, 1, 2)
    return torch.where(leaves, its_choice, choice)
