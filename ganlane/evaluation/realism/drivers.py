"""The two ends of the scale, driving at random and going on as one began; and IDM with headways of its own."""

from __future__ import annotations

import torch
from torch import Tensor

from ganlane.generator.rollout import headway_from_uniform
from ganlane.sim.following import following_acceleration
from ganlane.sim.hazard import random_side
from ganlane.sim.neighbours import perceive
from ganlane.sim.random import Purpose, Stream, uniform
from ganlane.sim.road import Road
from ganlane.sim.vehicles import Vehicles
from ganlane.traffic.base import TrafficModule


class ConstantVelocity(TrafficModule):
    """Everybody goes straight on at the speed it had when it entered."""

    def move(self, vehicles: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor) -> tuple[Vehicles, dict]:
        """One step along the road."""
        v = vehicles
        return v.with_(x=v.x + v.speed * self.dt, acceleration=torch.zeros_like(v.speed)), memory


class RandomDriving(TrafficModule):
    """The floor: nobody looks at anything.

    An acceleration is drawn every second, uniform up to ``hardest`` either way; a lane change to a random side starts
    at a constant hazard and takes ``change_s`` seconds. Nobody drives backwards.

    Args:
        road, stream: as for every traffic module.
        hardest: m/s2.
        every_s: mean time between two lane changes of a vehicle, s.
        change_s: how long a change takes, s.
    """

    def __init__(
        self,
        road: Road | None = None,
        stream: int = Stream.TRAIN,
        hardest: float = 3.0,
        every_s: float = 20.0,
        change_s: float = 4.0,
    ) -> None:
        super().__init__(road, stream)
        self.hardest, self.every_s, self.change_s = hardest, every_s, change_s

    def move(self, vehicles: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor) -> tuple[Vehicles, dict]:
        """One step: the second's acceleration, and towards the target lane."""
        v, m, dtype = vehicles, vehicles.x.shape[1], vehicles.x.dtype
        pace = uniform(key, torch.div(step, 10, rounding_mode="floor"), m, [Purpose.ACCELERATION], dtype)[..., 0]
        drawn = uniform(key, step, m, [Purpose.LANE_CHANGE_HAZARD, Purpose.LANE_CHANGE_SIDE], dtype)
        remaining = self.road.centre_of(v.target_lane, dtype) - v.y
        starts = (drawn[..., 0] < self.dt / self.every_s) & (remaining.abs() < 0.3)
        side = torch.where(starts, random_side(drawn[..., 1], v.target_lane, self.road.lanes), 0)
        target = v.target_lane + side
        stride = self.road.lane_width_m * self.dt / self.change_s
        aside = (remaining / stride).clamp(-1.0, 1.0) * stride
        speed = (v.speed + self.hardest * (2.0 * pace - 1.0) * self.dt).clamp_min(0.0)
        moved = v.with_(
            x=v.x + 0.5 * (v.speed + speed) * self.dt,
            y=v.y + aside,
            speed=speed,
            acceleration=(speed - v.speed) / self.dt,
            target_lane=target,
        )
        return moved, memory


class HeadwayIdm(TrafficModule):
    """IDM in the lane, every driver with a headway of its own: what is left of generated traffic without a network.

    A control, not one of the rules that ship: Table V gives everybody the same headway. Memory: ``headway`` [N, M]
    in s, drawn as the recorded ones are distributed, or shown at a recorded start.
    """

    memory_fields = {"headway": ((), None)}  # noqa: RUF012

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> dict[str, Tensor]:
        """A headway for everybody."""
        u = uniform(key, -1, vehicles.x.shape[1], [Purpose.TRAIT_HEADWAY], vehicles.x.dtype)[..., 0]
        return {"headway": headway_from_uniform(u)}

    def move(self, vehicles: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor) -> tuple[Vehicles, dict]:
        """One step along the road."""
        v = vehicles
        wanted = following_acceleration(perceive(v, self.road), headway_s=memory["headway"])
        speed = (v.speed + wanted * self.dt).clamp_min(0.0)
        x = v.x + 0.5 * (v.speed + speed) * self.dt
        return v.with_(x=x, speed=speed, acceleration=(speed - v.speed) / self.dt), memory
