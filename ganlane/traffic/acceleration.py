"""Sudden accelerations laid over a traffic model: the paper's 'instant-acceleration or instant-slowing'."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ganlane.sim.random import Purpose, Stream, normal, uniform
from ganlane.sim.state import Road, Vehicles
from ganlane.traffic.base import Memory, Moved, Overlay


@dataclass(frozen=True)
class SuddenAccelerations:
    """Mean time between two (s), duration (s), mean and standard deviation of their Gaussian (m/s2)."""

    every_s: float = 10.0
    lasts_s: float = 1.0
    mean: float = 0.0
    sd: float = 0.8


class AccelerationOverlay(Overlay):
    """At times a driver accelerates or brakes by an amount drawn from the recorded accelerations.

    The paper says that accelerations 'were added manually' and no more. Here they come at a constant hazard and
    replace the base model's acceleration for a second. Memory: the acceleration (m/s2) and its remaining steps.
    """

    memory_fields = {"acceleration": ((), None), "left": ((), torch.int64)}  # noqa: RUF012

    def __init__(
        self, road: Road | None = None, stream: int = Stream.TRAIN, sudden: SuddenAccelerations | None = None
    ) -> None:
        super().__init__(road, stream)
        self.sudden = sudden or SuddenAccelerations()

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> Memory:
        """No sudden acceleration."""
        return {"acceleration": torch.zeros_like(vehicles.x), "left": torch.zeros_like(vehicles.target_lane)}

    def rewrite(self, vehicles: Vehicles, moved: Vehicles, memory: Memory, key: Tensor, step: Tensor) -> Moved:
        """Replace speed and position along the road during a sudden acceleration."""
        s, m, dtype = self.sudden, vehicles.x.shape[1], vehicles.x.dtype
        u = uniform(key, step, m, [Purpose.ACCELERATION], dtype)[..., 0]
        gauss = normal(key, step, m, [Purpose.ACCELERATION], dtype)[..., 0]
        starts = (memory["left"] == 0) & (u < self.dt / s.every_s) & vehicles.valid
        acceleration = torch.where(starts, s.mean + s.sd * gauss, memory["acceleration"])
        left = torch.where(starts, round(s.lasts_s / self.dt), memory["left"])
        active = left > 0
        speed = (vehicles.speed + acceleration * self.dt).clamp_min(0.0)
        moved = moved.with_(
            speed=torch.where(active, speed, moved.speed),
            acceleration=torch.where(active, (speed - vehicles.speed) / self.dt, moved.acceleration),
            x=torch.where(active, vehicles.x + 0.5 * (vehicles.speed + speed) * self.dt, moved.x),
        )
        return moved, {"acceleration": acceleration, "left": (left - 1).clamp_min(0)}
