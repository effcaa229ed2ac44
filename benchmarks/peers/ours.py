"""The scene in ganlane: the traffic module that the package ships, in float64, on one lane."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from benchmarks.peers.scene import DESIRED_SPEED_MPS, LENGTH_M, Scene, Trace
from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.lanes import Visibility
from ganlane.sim.state import Road, Vehicles
from ganlane.traffic.idm_mobil import IdmTraffic


def vehicles_of(scene: Scene, dtype: torch.dtype = torch.float64) -> Vehicles:
    """The first moment of ``scene`` as one row of vehicles on the centre of lane 0."""
    speed = torch.tensor([scene.speeds_mps], dtype=dtype)
    zero, whole = torch.zeros_like(speed), torch.zeros_like(speed, dtype=torch.int64)
    return Vehicles(
        x=torch.tensor(scene.positions_m(), dtype=dtype)[None],
        y=zero,
        heading=zero,
        speed=speed,
        acceleration=zero,
        length=zero + LENGTH_M,
        width=zero + 2.5,
        desired_speed=zero + DESIRED_SPEED_MPS,
        target_lane=whole,
        visibility=whole + int(Visibility.BODY),
        valid=whole == 0,
    )


def led(before: Vehicles, moved: Vehicles, leader_mps: float, dt: float) -> Vehicles:
    """``moved`` with the foremost at its prescribed speed, at constant acceleration within the step."""
    speed, x = moved.speed.clone(), moved.x.clone()
    speed[:, 0] = leader_mps
    x[:, 0] = before.x[:, 0] + 0.5 * dt * (before.speed[:, 0] + leader_mps)
    return moved.with_(speed=speed, x=x)


def drive(scene: Scene, dt: float = PHYSICS_STEP_S, dtype: torch.dtype = torch.float64) -> Trace:
    """Drive ``scene`` with :class:`~ganlane.traffic.idm_mobil.IdmTraffic` as it stands, at steps of ``dt`` s."""
    traffic = IdmTraffic(Road(lanes=1))
    traffic.dt = dt
    vehicles = vehicles_of(scene, dtype)
    key = torch.zeros(1, dtype=torch.int64)
    memory = traffic.fresh_memory(vehicles, key)
    speeds, positions = [vehicles.speed], [vehicles.x]
    for step in range(scene.steps(dt)):
        moved, memory = traffic.move(vehicles, memory, key, key + step)
        vehicles = led(vehicles, moved, scene.leader_speeds(dt)[step + 1], dt) if scene.leader else moved
        speeds.append(vehicles.speed)
        positions.append(vehicles.x)
    return Trace(_stack(speeds), _stack(positions))


def _stack(rows: list[Tensor]) -> np.ndarray:
    return torch.cat(rows).double().numpy()
